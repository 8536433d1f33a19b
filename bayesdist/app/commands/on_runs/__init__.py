"""Commands that read runs: budgets, comparisons, monitoring, releases."""
