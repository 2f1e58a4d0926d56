"""Plants, costs, networks, triggers and policies: frozen data, checked when they are made."""
