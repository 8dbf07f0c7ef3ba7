"""Who may do what: keys, tickets and limits, before every route of every door."""
