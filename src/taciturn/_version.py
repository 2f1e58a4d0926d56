"""The version of the package, for whoever stands below its public names."""

VERSION = "0.1.0"
