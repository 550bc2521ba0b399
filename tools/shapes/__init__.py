"""How the embedded model came to be: its training pictures, its training and its evaluation."""
