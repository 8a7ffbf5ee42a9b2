"""The parameters of the nodes. The tables in ros2_ws/README.md repeat them; a test compares."""

from metagcttt.parameter_set import Parameter

ENVIRONMENT = Parameter(
    'environment', 'pointmaze-medium-v0', 'name of the maze, as sim_bridge knows it'
)
STEPPING = Parameter(
    'stepping',
    'realtime',
    'realtime: the world goes on by itself; lockstep: it waits for the action of every step. '
    'The same for all nodes',
    choices=('realtime', 'lockstep'),
)
FRAME_ID = Parameter('frame_id', 'map', 'frame of the maze, of all positions and of all goals')
DIAGNOSTICS_PERIOD_S = Parameter(
    'diagnostics_period_s',
    1.0,
    'time between two messages on /diagnostics, seconds',
    minimum=0.01,
    maximum=3600,
)
DATASET = Parameter('dataset', '', 'dataset file (.npz); empty: the committed one')

GOAL_NODE = (
    ENVIRONMENT,
    DATASET,
    STEPPING,
    FRAME_ID,
    DIAGNOSTICS_PERIOD_S,
    Parameter(
        'goal_tolerance_m',
        0.0,
        "a goal is reached within this distance, metres; 0: the environment's own",
        minimum=0,
        maximum=1000,
        changes='now',
    ),
    Parameter(
        'max_steps',
        0,
        "control steps that a goal may take; 0: the environment's own limit",
        minimum=0,
        maximum=10**6,
        changes='now',
    ),
    Parameter(
        'seed',
        0,
        'seed of the adaptation to goals that are not those of a task',
        minimum=0,
        maximum=2**63 - 1,
        changes='now',
    ),
    Parameter(
        'state_timeout_s',
        5.0,
        'a goal is given up when the simulator is gone, in realtime also silent, for this long, '
        'seconds',
        minimum=0.1,
        maximum=3600,
        changes='now',
    ),
    Parameter(
        'goal_lease_s',
        2.0,
        'the policy drops a goal when this node, which repeats it, is silent for this long, '
        'seconds; 0: never',
        minimum=0,
        maximum=3600,
        changes='now',
    ),
    Parameter(
        'policy_timeout_s',
        2.0,
        'diagnostics warn when a goal is in force and no policy was heard for this long, seconds',
        minimum=0.1,
        maximum=3600,
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
        minimum=0.01,
        maximum=1000,
        changes='now',
    ),
    Parameter(
        'action_timeout_s',
        0.5,
        'realtime: an action older than this counts as zero, simulated seconds',
        minimum=0.01,
        maximum=3600,
        changes='now',
    ),
    DIAGNOSTICS_PERIOD_S,
    Parameter('publish_clock', True, 'publish the simulated time on /clock'),
    Parameter('seed', 0, 'seed of the first episode', minimum=0, maximum=2**32 - 1),
    Parameter('start_paused', False, 'stand still until the service pause says otherwise'),
)

POLICY_NODE = (
    DIAGNOSTICS_PERIOD_S,
    Parameter('autostart', True, 'configure and activate at the start'),
    Parameter(
        'checkpoint', '', 'folder of the policy; empty: the committed one', changes='configure'
    ),
    Parameter(DATASET.name, DATASET.default, DATASET.description, changes='configure'),
    Parameter(
        STEPPING.name,
        STEPPING.default,
        STEPPING.description,
        choices=STEPPING.choices,
        changes='configure',
    ),
    Parameter(
        'adaptation',
        'async',
        'async: act with the weights in hand until the expert is ready; hold: wait for it',
        choices=('async', 'hold'),
        changes='now',
    ),
    Parameter(
        'adapt_steps',
        10,
        'gradient steps per goal; 0: act with the base policy',
        minimum=0,
        maximum=10000,
        changes='now',
    ),
    Parameter(
        'adapt_lr',
        3e-4,
        'learning rate of the adaptation',
        minimum=1e-8,
        maximum=1,
        changes='now',
    ),
    Parameter(
        'adapt_batch_size',
        256,
        'transitions per gradient step',
        minimum=1,
        maximum=10**6,
        changes='now',
    ),
    Parameter(
        'early_stopping',
        False,
        'hold out part of the support set and keep the step that does best on it',
        changes='now',
    ),
    Parameter(
        'test_fraction',
        0.2,
        'share of the support set that early stopping holds out',
        minimum=0.01,
        maximum=0.99,
        changes='now',
    ),
    Parameter('actor_only', False, 'adapt the actor alone, not the critic', changes='now'),
    Parameter(
        'horizon',
        0,
        'control steps after which to adapt anew from the base weights; 0: never',
        minimum=0,
        maximum=10**6,
        changes='now',
    ),
    Parameter(
        'cache_size',
        0,
        'experts to keep for queries from the same cell to the same cell; 0: none',
        minimum=0,
        maximum=10000,
        changes='configure',
    ),
    Parameter(
        'cache_cell_m',
        1.0,
        'edge of the cells that tell whether an expert fits again, metres',
        minimum=0.001,
        maximum=1000,
        changes='configure',
    ),
    Parameter(
        'filter_variant',
        'gcttt',
        'rule that chooses the sub-trajectories to adapt on',
        choices=('gcttt', 'paper'),
        changes='configure',
    ),
    Parameter(
        'epsilon',
        1.0,
        'a trajectory is relevant when it passes this close to the agent, metres',
        minimum=0.001,
        maximum=1000,
        changes='configure',
    ),
    Parameter(
        'top_percent',
        20.0,
        'share of the relevant trajectories that is kept, percent',
        minimum=0.001,
        maximum=100,
        changes='configure',
    ),
    Parameter(
        'rate_hz',
        20.0,
        'realtime: actions per second of the node clock, besides one at once for every state',
        minimum=0.1,
        maximum=1000,
        changes='now',
    ),
    Parameter(
        'state_timeout_s',
        0.5,
        'realtime: without a state for this long the action is zero, seconds, both of the node '
        'clock and of real time',
        minimum=0.01,
        maximum=3600,
        changes='now',
    ),
    Parameter(
        'warn_latency_ms',
        20.0,
        'diagnostics warn when 99 % of states are not answered within this time, milliseconds',
        minimum=0,
        maximum=10**6,
        changes='now',
    ),
    Parameter(
        'warn_missed_deadlines',
        0,
        'diagnostics warn when more control periods than this passed without an action in a '
        'minute; on simulated time, the steps of the simulator towards a goal',
        minimum=0,
        maximum=10**6,
        changes='now',
    ),
    Parameter(
        'warn_adapt_ms',
        10000.0,
        'diagnostics warn when an adaptation takes longer, milliseconds',
        minimum=0,
        maximum=10**9,
        changes='now',
    ),
    Parameter(
        'threads',
        1,
        "threads that PyTorch uses in the adaptation; 0: PyTorch's own choice",
        minimum=0,
        maximum=256,
        changes='configure',
    ),
)

RECORDER_NODE = (
    Parameter(
        'output', '', 'file to write (.mcap), which must not exist; empty: rec-DATE-TIME.mcap here'
    ),
    Parameter(
        'split_mb',
        0.0,
        'begin another file when one is this large, megabytes; 0: never',
        minimum=0,
        maximum=1000000,
    ),
    Parameter(
        'flush_s',
        1.0,
        'how often what was recorded goes to the file, seconds; a killed recorder loses no more',
        minimum=0.01,
        maximum=3600,
    ),
)

VISUALIZATION_NODE = (
    ENVIRONMENT,
    DATASET,
    Parameter(
        'checkpoint', '', 'folder of the policy, whose critic is shown; empty: the committed one'
    ),
    Parameter('base_frame_id', 'base_link', "the agent's own frame, in which odom has its speed"),
    Parameter(
        'rate_hz',
        2.0,
        'how often path and markers are published when they have changed, per second',
        minimum=0.1,
        maximum=20,
    ),
    Parameter(
        'path_poses',
        500,
        'poses of the path, 0.1 m apart; older ones are dropped',
        minimum=2,
        maximum=5000,
    ),
    Parameter(
        'marker_points',
        2000,
        'points of the retrieved sub-trajectories; more are thinned out',
        minimum=2,
        maximum=50000,
        changes='now',
    ),
)

TABLES = {
    'goal_node': GOAL_NODE,
    'policy_node': POLICY_NODE,
    'recorder_node': RECORDER_NODE,
    'sim_bridge_node': SIM_BRIDGE_NODE,
    'visualization_node': VISUALIZATION_NODE,
}
