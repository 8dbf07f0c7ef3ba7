"""What a user imports and types: the command line, the client, data sets and evaluation."""
