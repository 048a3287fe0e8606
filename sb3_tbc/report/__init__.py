"""Tables, curves and the page that shows them, from the results ledger."""
