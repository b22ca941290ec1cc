"""The version, for modules that cannot import the package."""

__version__ = "0.1.0"
