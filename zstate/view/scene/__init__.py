"""What is drawn of the robots: their bodies, axes, names, lines and trails."""
