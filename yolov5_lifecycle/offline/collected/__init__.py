"""The command `collected`: what a detector has collected, looked at, split and removed."""
