"""Sphinx configuration: every code cell is executed, and an error fails the build."""

project = "Taciturn"
author = "The Taciturn authors"
extensions = ["myst_nb"]
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_execution_in_temp = True
html_theme = "furo"
html_title = "Taciturn"
exclude_patterns = ["_build"]
mathjax_path = ""  # pages must build and open without a network
