"""What a user may write into a configuration, and how it is read."""
