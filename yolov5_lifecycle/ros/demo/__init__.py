"""The demonstration, which drives and checks camera and detector from outside."""
