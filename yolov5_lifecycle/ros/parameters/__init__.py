"""Parameters of a node: declared, read from a request, validated once, stored."""
