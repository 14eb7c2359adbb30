"""The version of lacli, in this one place: the package's metadata and the public interface take it from here."""

__version__ = "0.1.0"
