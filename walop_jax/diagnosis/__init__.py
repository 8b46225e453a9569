"""Missing effects: the alarm, the name, the addition, and the alternatives that data cannot separate."""
