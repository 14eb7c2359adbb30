"""The version of lacli: here, below all rooms, so that none needs the public interface to know it."""

__version__ = "0.1.0"
