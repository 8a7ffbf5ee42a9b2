"""Reading MCAP recordings, and what can be seen in them."""
