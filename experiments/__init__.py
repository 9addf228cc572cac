"""What people run: the command line, studies, tables."""
