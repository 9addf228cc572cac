"""The programs that people run: the command line, studies, tables."""
