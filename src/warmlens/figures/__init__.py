"""Figures of a campaign and of the paper: data read from artifacts, drawn, and written beside each other."""

from warmlens.figures.captions import CAPTIONS

__all__ = ["CAPTIONS"]
