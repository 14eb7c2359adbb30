"""Regional stiffness of the left atrium: anatomy, mechanics, inference."""

__version__ = "0.1.0"
