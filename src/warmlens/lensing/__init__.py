"""Deflections of the smooth lens and of its subhalos."""
