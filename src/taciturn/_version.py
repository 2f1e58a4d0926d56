"""Version number of the package. This module imports nothing, so that the version can be read quickly."""

__version__ = "1.7.0"
