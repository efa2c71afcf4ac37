"""From the image of a strong gravitational lens to a lower bound on the mass of warm dark matter."""

from importlib.metadata import version

__version__ = version("warmlens")
