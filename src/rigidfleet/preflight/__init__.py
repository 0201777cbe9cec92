"""What can be said about a mission before it flies."""
