"""From settings by name to the objects of a run or of a study: what any front end needs, and Hydra composes."""
