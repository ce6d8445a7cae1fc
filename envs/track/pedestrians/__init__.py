"""The pedestrian scene: people who walk a lobby by a social force model, and the picture of them with its truth."""
