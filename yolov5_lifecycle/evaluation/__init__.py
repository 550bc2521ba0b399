"""How good a model is on labelled images: ground truth, matching and figures."""
