"""Deflections of the macro model and of its subhalos."""
