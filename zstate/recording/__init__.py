"""Recordings: reading robots from MCAP files and bags."""
