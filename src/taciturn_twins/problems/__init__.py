"""Built-in problems of the robots."""
