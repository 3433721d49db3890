"""`zstate up`: from a file to processes that start, live and end in order."""
