"""Tables and diagrams of several bands beside each other."""
