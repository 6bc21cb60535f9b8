"""What must survive: scenes with every revision, uploaded assets, tokens. `store.Store` is the way in."""
