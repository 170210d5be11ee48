"""What talks to a running localizer: its process, messages in and out, and the player of bags."""
