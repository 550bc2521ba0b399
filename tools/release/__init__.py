"""What a release consists of: source archive, wheel, wheels of the messages, and what must hold for them."""
