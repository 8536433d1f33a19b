"""`bayesdist wise bands`: tables and diagrams of several bands beside each other."""
