"""Drawing of figures: style, panels, fields of arrows, and figures of commands."""
