"""Trained policies: reads a network from its file, and measures the law made of it as machine code of the board."""
