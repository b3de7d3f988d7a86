"""What a run is: its folder, its stages one after the other, and the tables of what it found."""
