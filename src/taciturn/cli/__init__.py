"""The command line. Everything heavy is imported when a command runs, so that help is quick."""

from taciturn.cli import answers, devices, network, new, studies, twin
from taciturn.cli.frame import app, main

__all__ = ["answers", "app", "devices", "main", "network", "new", "studies", "twin"]
