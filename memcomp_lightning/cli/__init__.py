"""The command line: reads and checks arguments, runs the commands, prints what they found."""
