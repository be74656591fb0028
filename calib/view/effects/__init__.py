"""Which effects a run's model is to have: ticks, what is known of a set of them, a formula of one's
own."""
