"""Looking at a model and at what an estimation says: sizes, frequencies, feasibility; nothing here changes anything."""
