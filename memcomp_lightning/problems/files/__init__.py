"""File formats of benchmark problems, one a file; ``formats`` is the table of them."""
