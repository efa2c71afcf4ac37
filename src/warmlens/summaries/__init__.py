"""Summary statistics of scan maps."""
