"""The version of the package, for whoever stands below its public names."""

__version__ = "1.0.0"
