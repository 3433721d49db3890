"""`zstate snapshot`: robots as they are now in a file, and out of it again."""
