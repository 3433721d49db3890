"""What a replay consists of: its pace, what stands at an instant, and the writers of one pass."""
