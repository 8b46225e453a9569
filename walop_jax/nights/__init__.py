"""Many nights of one instrument: normal equations that are kept, stacked under laws of time, and asked for breaks."""
