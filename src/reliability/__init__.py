"""What keeps a run alive: its processes, interruption, checkpoints, steps that are not finite, exit status, allocator.

Pinned to Lightning 2.6 (`pyproject.toml`): check these places before raising that bound.

- `interruption`: in fit and validate Lightning puts signal handlers of its own before ours, which wait for the other
  ranks; a checkpoint written before a step or a validation counts that batch twice; an epoch's metrics are logged after
  the checkpoint of its end. So hooks set the handlers again, correct the saved counters (`loops`,
  `_batches_that_stepped`) and log the metrics first (`_logger_connector`).
- `checkpoints`: Lightning writes through the system's temporary folder and reads back nothing.
- `metrics_csv`: its CSVLogger deletes the rows of an earlier start.
- `processes`: Lightning starts ranks itself, inside `Trainer.fit`, and its DDP lets every forward broadcast buffers.

Outside this room `training.fit` (KeyboardInterrupt arrives as SystemExit; validation with padded samples), `data.clips`
(a rank without validation batches is left out) and `data.frame_loader` (loaders need `state_dict`) do likewise.
"""
