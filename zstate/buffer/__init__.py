"""Time-indexed transform buffer: histories of joints and poses, and lookups at any stamp in them."""
