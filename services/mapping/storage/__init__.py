"""What is on disk, and whose it is."""
