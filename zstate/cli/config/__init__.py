"""What a command is told from outside: options, the environment, files."""
