"""What a surveyor hands over of a run: map, trajectory, layers, plans, a sheet to sign, and how they were made."""
