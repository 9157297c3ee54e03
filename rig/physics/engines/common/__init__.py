"""What engines share: their memory, events, and the march of one-step methods through them."""
