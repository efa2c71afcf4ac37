"""Pixels, point spread function, source, noise: what makes an image."""
