"""zstate monitor: how the samples behind one pose come in."""
