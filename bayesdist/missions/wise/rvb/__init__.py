"""Reference positions of RvB pairs, moved by linear transformations: TRSrvb and RERrvb."""
