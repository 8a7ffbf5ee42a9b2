"""Parameter tables of the nodes. A test compares those in ros2_ws/README.md with them."""

from dataclasses import replace

from metagcttt.parameter_set import Parameter

ENVIRONMENT = Parameter('environment', 'pointmaze-medium-v0', 'name of the maze in sim_bridge')
STEPPING = Parameter(
    'stepping',
    'realtime',
    'realtime: the simulator steps on its own; lockstep: it waits for the action of every step. '
    'The same for all nodes',
    choices=('realtime', 'lockstep'),
)
FRAME_ID = Parameter('frame_id', 'map', 'frame of the maze, of all positions and of all goals')
DIAGNOSTICS_PERIOD_S = Parameter(
    'diagnostics_period_s', 1.0, 'period of the messages on /diagnostics, seconds', (0.01, 3600)
)
CHECKPOINT = Parameter('checkpoint', '', 'folder of the policy; empty: the committed one')
DATASET = Parameter('dataset', '', 'dataset file (.npz); empty: the committed one')
FILTER = (
    Parameter(
        'filter_variant',
        'gcttt',
        'rule that selects the sub-trajectories to adapt on',
        choices=('gcttt', 'paper'),
        changes='configure',
    ),
    Parameter(
        'epsilon',
        0.0,
        'distance within which a trajectory has to pass the robot to be relevant, metres; 0: that '
        "of the robot's contract, or 1",
        (0, 1000),
        changes='configure',
    ),
    Parameter(
        'top_percent',
        20.0,
        'share of the relevant trajectories to keep, percent',
        (0.001, 100),
        changes='configure',
    ),
)

GOAL_NODE = (
    Parameter(
        'contract',
        '',
        "a robot's contract (YAML), whose frame, tolerances, time and map decide about goals "
        'instead of those of `environment`; empty: a maze',
    ),
    ENVIRONMENT,
    DATASET,
    STEPPING,
    FRAME_ID,
    DIAGNOSTICS_PERIOD_S,
    Parameter(
        'goal_tolerance_m',
        0.0,
        "distance within which a goal is reached, metres; 0: the environment's own",
        (0, 1000),
        changes='now',
    ),
    Parameter(
        'max_steps',
        0,
        "control steps that a goal may take; 0: the environment's own limit",
        (0, 10**6),
        changes='now',
    ),
    Parameter(
        'seed',
        0,
        "random seed of the adaptation to goals other than a task's",
        (0, 2**63 - 1),
        changes='now',
    ),
    Parameter(
        'state_timeout_s',
        5.0,
        'a goal ends when the simulator has been gone (in realtime: or silent) this long, seconds',
        (0.1, 3600),
        changes='now',
    ),
    Parameter(
        'partner_timeout_s',
        10.0,
        'lockstep: a goal ends after this long without a step and without a policy status, '
        'seconds',
        (0.1, 3600),
        changes='now',
    ),
    Parameter(
        'goal_lease_s',
        2.0,
        'the policy drops a goal that this node has not repeated for this long, seconds; 0: never',
        (0, 3600),
        changes='now',
    ),
    Parameter(
        'policy_timeout_s',
        2.0,
        'with a goal in force, diagnostics warn after this long without a policy status, seconds',
        (0.1, 3600),
        changes='now',
    ),
)

SIM_BRIDGE_NODE = (
    ENVIRONMENT,
    STEPPING,
    FRAME_ID,
    Parameter(
        'speed_factor',
        1.0,
        'realtime: simulated seconds per second',
        (0.01, 1000),
        changes='now',
    ),
    Parameter(
        'action_timeout_s',
        0.5,
        'realtime: an older action is replaced by zero, simulated seconds',
        (0.01, 3600),
        changes='now',
    ),
    DIAGNOSTICS_PERIOD_S,
    Parameter('publish_clock', True, 'publish the simulated time on /clock'),
    Parameter('seed', 0, 'random seed of the first episode', (0, 2**32 - 1)),
    Parameter(
        'standing',
        False,
        'start the tasks of humanoids on their feet, not dropped as OGBench does',
    ),
    Parameter('start_paused', False, 'start paused, until the service pause resumes'),
)

ADAPTER_NODE = (
    DIAGNOSTICS_PERIOD_S,
    CHECKPOINT,
    DATASET,
    *(replace(parameter, changes='start') for parameter in FILTER),
    Parameter('workers', 1, 'adaptations at the same time, each in a thread', (1, 256)),
    Parameter(
        'queue',
        20,
        'requests that wait for a worker at most; further ones are refused',
        (0, 10000),
    ),
    Parameter(
        'robots',
        100,
        'robots served at most; one that is gone for a minute leaves its place',
        (1, 10000),
    ),
    Parameter(
        'max_steps', 1000, 'gradient steps that a request may ask for', (1, 10**6), changes='now'
    ),
    Parameter(
        'max_batch_size',
        4096,
        'transitions per gradient step that a request may ask for',
        (1, 10**6),
        changes='now',
    ),
    Parameter(
        'threads',
        1,
        "PyTorch threads of each adaptation; 0: PyTorch's default",
        (0, 256),
    ),
)

POLICY_NODE = (
    DIAGNOSTICS_PERIOD_S,
    Parameter('autostart', True, 'configure and activate at start-up'),
    replace(CHECKPOINT, changes='configure'),
    replace(DATASET, changes='configure'),
    replace(STEPPING, changes='configure'),
    Parameter(
        'adaptation',
        'async',
        'async: act with the current weights until the expert is ready; hold: wait for it',
        choices=('async', 'hold'),
        changes='now',
    ),
    Parameter(
        'adapt_steps',
        10,
        'gradient steps per goal; 0: act with the base policy',
        (0, 10000),
        changes='now',
    ),
    Parameter('adapt_lr', 3e-4, 'learning rate of the adaptation', (1e-8, 1), changes='now'),
    Parameter('adapt_batch_size', 256, 'transitions per gradient step', (1, 10**6), changes='now'),
    Parameter(
        'early_stopping',
        False,
        'hold out part of the support set and use the step with the lowest loss on it',
        changes='now',
    ),
    Parameter(
        'test_fraction',
        0.2,
        'fraction of the support set held out by early stopping and the guard',
        (0.01, 0.99),
        changes='now',
    ),
    Parameter(
        'guard',
        'none',
        'hold out part of the support set and act with the base policy unless the loss on it, or '
        'the negative log-likelihood of its actions (imitation), fell',
        choices=('none', 'loss', 'imitation'),
        changes='now',
    ),
    Parameter('actor_only', False, 'adapt the actor and not the critic', changes='now'),
    Parameter(
        'optimizer_state',
        'fresh',
        'Adam moments and step count to begin an adaptation with; pretrained: those kept in the '
        'checkpoint',
        choices=('fresh', 'pretrained'),
        changes='now',
    ),
    Parameter(
        'engine',
        'auto',
        'what computes the gradient steps: kernels in C, the same in tensor operations, autograd; '
        'auto: the first of them that policy and machine have',
        choices=('auto', 'kernels', 'analytic', 'eager'),
        changes='now',
    ),
    Parameter(
        'precision',
        'float32',
        'of the matrix products; auto: bfloat16 where the machine gains by it',
        choices=('float32', 'bfloat16', 'auto'),
        changes='now',
    ),
    Parameter(
        'horizon',
        0,
        'control steps after which to adapt again from the base weights; 0: never',
        (0, 10**6),
        changes='now',
    ),
    Parameter(
        'adapter',
        '',
        'service of an adapter_node that adapts instead of this node, such as /adapt; empty: none',
        changes='configure',
    ),
    Parameter(
        'adapter_timeout_s',
        2.0,
        'longest wait for an expert of the adapter, seconds',
        (0.05, 3600),
        changes='now',
    ),
    Parameter(
        'adapter_fallback',
        'local',
        'without an expert of the adapter: adapt in this node, or act with the base policy',
        choices=('local', 'base'),
        changes='now',
    ),
    Parameter(
        'cache_size',
        0,
        'experts to cache for goals from the same cell to the same cell; 0: none',
        (0, 10000),
        changes='configure',
    ),
    Parameter(
        'cache_cell_m',
        1.0,
        'edge length of the cells of the expert cache, metres',
        (0.001, 1000),
        changes='configure',
    ),
    *FILTER,
    Parameter(
        'rate_hz',
        20.0,
        'realtime: rate of actions by the node clock; a new state is answered at once besides',
        (0.1, 1000),
        changes='now',
    ),
    Parameter(
        'state_timeout_s',
        0.5,
        'realtime: after this long without a state, by the node clock or in real time, the action '
        'is zero, seconds',
        (0.01, 3600),
        changes='now',
    ),
    Parameter(
        'warn_latency_ms',
        20.0,
        'diagnostics warn above this 99th percentile of the time from state to action, '
        'milliseconds',
        (0, 10**6),
        changes='now',
    ),
    Parameter(
        'warn_missed_deadlines',
        0,
        'diagnostics warn above this number of control periods without an action in a minute; on '
        'simulated time, of simulator steps towards a goal',
        (0, 10**6),
        changes='now',
    ),
    Parameter(
        'warn_adapt_ms',
        10000.0,
        'diagnostics warn above this duration of an adaptation, milliseconds',
        (0, 10**9),
        changes='now',
    ),
    Parameter(
        'threads',
        1,
        "PyTorch threads of the adaptation; 0: PyTorch's default",
        (0, 256),
        changes='configure',
    ),
)

RECORDER_NODE = (
    Parameter(
        'output',
        '',
        'file (.mcap) or bag folder to write, which must not exist; empty: ./rec-DATE-TIME.mcap',
    ),
    Parameter(
        'hidden_topics',
        False,
        'record hidden topics too, such as the feedback and the status of actions',
    ),
    Parameter('split_mb', 0.0, 'start a new file at this size, megabytes; 0: never', (0, 1000000)),
    Parameter(
        'flush_s',
        1.0,
        'period of flushing to the file, seconds; a killed recorder loses no more than that',
        (0.01, 3600),
    ),
)

ROBOT_BRIDGE_NODE = (
    Parameter('contract', 'robot.yaml', "the robot's contract (YAML); config/robots has some"),
    DIAGNOSTICS_PERIOD_S,
)

VISUALIZATION_NODE = (
    ENVIRONMENT,
    DATASET,
    replace(
        CHECKPOINT,
        description='folder of the policy, whose critic is shown; empty: the committed one',
    ),
    Parameter('base_frame_id', 'base_link', "the robot's own frame, of the velocity in odom"),
    Parameter(
        'rate_hz', 2.0, 'highest rate of path and markers, which follow changes, hertz', (0.1, 20)
    ),
    Parameter('path_poses', 500, 'length of the path in poses, 0.1 m apart', (2, 5000)),
    Parameter(
        'marker_points',
        2000,
        'points of the retrieved sub-trajectories, which are thinned to about as many',
        (2, 50000),
        changes='now',
    ),
)

TABLES = {
    'adapter_node': ADAPTER_NODE,
    'goal_node': GOAL_NODE,
    'policy_node': POLICY_NODE,
    'recorder_node': RECORDER_NODE,
    'robot_bridge_node': ROBOT_BRIDGE_NODE,
    'sim_bridge_node': SIM_BRIDGE_NODE,
    'visualization_node': VISUALIZATION_NODE,
}
