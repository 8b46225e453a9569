"""What the commands do, from files to files: each function takes paths and options, and returns what it found."""
