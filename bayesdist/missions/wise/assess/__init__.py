"""What the WISE report (WSDC D-T033) prints, and its residual tables beside it."""
