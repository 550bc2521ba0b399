"""How well and how fast objects are tracked: scenes, cameras that move, figures."""
