"""The command `collected`: what a detector has collected, looked at, merged, split and removed."""
