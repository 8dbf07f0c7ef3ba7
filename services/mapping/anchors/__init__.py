"""The anchors of the map: where they are, how they come, move and go."""
