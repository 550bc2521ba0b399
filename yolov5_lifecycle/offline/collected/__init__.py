"""The command `collected`: what a detector has collected, looked at and split."""
