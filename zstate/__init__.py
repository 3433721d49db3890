"""A robot's state wherever Zenoh reaches."""
