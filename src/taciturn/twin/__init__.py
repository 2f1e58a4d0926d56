"""Digital twins of two robots: rigid bodies in MuJoCo, a camera that looks at them, and an eye that measures."""
