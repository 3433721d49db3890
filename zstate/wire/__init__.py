"""How it is said: messages, their bytes and the keys they travel under. Pure: no I/O."""
