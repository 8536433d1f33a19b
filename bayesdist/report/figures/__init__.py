"""What figures are drawn with: style, panels, fields of arrows, and figures of commands."""
