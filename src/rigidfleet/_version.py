"""The version, which other modules need without the rest of the package."""

__version__ = "0.1.0"
