"""The version of the package, for whoever stands below its public names."""

__version__ = "0.1.0"
