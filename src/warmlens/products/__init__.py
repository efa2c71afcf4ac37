"""What lies in each artifact, written and read in one place."""
