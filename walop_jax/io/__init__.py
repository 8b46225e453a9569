"""Files, opened, checked, written whole or not at all; errors, progress, and tables and text on a terminal."""
