"""The commands by what they are for; each imports only what it needs, when it is called."""
