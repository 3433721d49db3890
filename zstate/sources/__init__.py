"""Where joint states come from."""
