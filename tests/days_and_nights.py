"""The small embedded data set of days and nights for tests of runs on two domains."""

DAYS_AND_NIGHTS = (
    *("dataset=synth_freiburg", "dataset.num_train_day=6", "dataset.num_train_night=5"),
    *("dataset.num_val=2", "dataset.num_test=4", "tracking=none"),
    *("scale.batch_size=2", "scale.eval_batch_size=4", "scale.critic_width=4"),
    *("trainer.accelerator=cpu", "trainer.threads=1", "trainer.log_every=1"),
)
