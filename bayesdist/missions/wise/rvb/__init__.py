"""Linear transformations of the reference positions of RvB pairs (TRSrvb and RERrvb)."""
