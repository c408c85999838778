"""Studies of policies: which cells they have, how these are run side by side, what their results say."""
