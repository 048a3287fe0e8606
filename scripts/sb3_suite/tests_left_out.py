"""Tests of Stable-Baselines3 that ask for what there is not here on purpose, and those that need a word of care."""

from __future__ import annotations

IMAGES = "images: a level sees a flat vector"
EXTRACTOR = "features extractors with batch norm or dropout: a level sees a flat vector"
SDE = "gSDE: refused, levels explore as SAC does without it"
ON_POLICY = "parts that on-policy algorithms alone have"
OF_DQN = "parts that DQN alone has"
BUFFER = "inner arrays and goal strategies of SB3's own replay buffers"
NORMALISED = "VecNormalize: refused, it would move the subgoal space"
DISCRETE = "discrete or many-dimensional actions: refused"
OPTIMISER = "optimisers: both levels use Adam"
SCHEDULE = "functions as learning rates: refused, lin_<rate> is the schedule there is"
POLICY_FILE = "a policy's own file: refused, both levels are saved with their agent"
NETWORK = "attributes of an agent with one network"
NO_AGENT = "no agent in it"
NOT_APPLICABLE = {
    "test_buffers.py::test_custom_rollout_buffer": ON_POLICY,
    "test_callbacks.py::test_eval_friendly_error": NORMALISED,
    "test_callbacks.py::test_checkpoint_additional_info": NORMALISED,
    "test_cnn.py::test_cnn": IMAGES,
    "test_cnn.py::test_vec_transpose_skip": IMAGES,
    "test_cnn.py::test_features_extractor_target_net": IMAGES,
    "test_cnn.py::test_channel_first_env": IMAGES,
    "test_cnn.py::test_image_like_input": IMAGES,
    "test_custom_policy.py::test_custom_optimizer": OPTIMISER,
    "test_custom_policy.py::test_tf_like_rmsprop_optimizer": OPTIMISER,
    "test_custom_policy.py::test_dqn_custom_policy": OPTIMISER,
    "test_dict_env.py::test_consistency": "policies for arrays: goal observations are dictionaries",
    "test_dict_env.py::test_vec_normalize": NORMALISED,
    "test_dict_env.py::test_dict_vec_framestack": IMAGES,
    "test_distributions.py::test_squashed_gaussian": SDE,
    "test_gae.py::test_gae_computation": ON_POLICY,
    "test_gae.py::test_infinite_horizon": NETWORK,
    "test_her.py::test_goal_selection_strategy": "action noise: levels explore as SAC does",
    "test_her.py::test_save_load_replay_buffer": BUFFER,
    "test_her.py::test_performance_her": DISCRETE,
    "test_identity.py::test_continuous": "how fast one level learns; the goal is another one in every step",
    "test_identity.py::test_discrete": DISCRETE,
    "test_logger.py::test_sb3_import_without_optional_deps": NO_AGENT,
    "test_n_step_replay.py::test_run": BUFFER,
    "test_predict.py::test_dqn_epsilon_greedy": OF_DQN,
    "test_run.py::test_advantage_normalization": ON_POLICY,
    "test_run.py::test_ppo": ON_POLICY,
    "test_run.py::test_ppo_warnings": ON_POLICY,
    "test_run.py::test_warn_dqn_multi_env": OF_DQN,
    "test_run.py::test_train_freq_fail": "train_freq: updates follow finished episodes",
    "test_save_load.py::test_save_load_env_cnn": IMAGES,
    "test_save_load.py::test_save_load_replay_buffer": BUFFER,
    "test_save_load.py::test_save_load_policy": POLICY_FILE,
    "test_save_load.py::test_save_load_q_net": OF_DQN,
    "test_save_load.py::test_save_load_large_model": "marked expensive, and left out by SB3 too",
    "test_save_load.py::test_load_invalid_object": SCHEDULE,
    "test_save_load.py::test_cast_lr_schedule": SCHEDULE,
    "test_save_load.py::test_save_load_backward_compatible": SCHEDULE,
    "test_save_load.py::test_save_load_clip_range_portable": ON_POLICY,
    "test_save_load.py::test_dqn_target_update_interval": OF_DQN,
    "test_save_load.py::test_save_load_net_arch_none": NETWORK,
    "test_save_load.py::test_save_load_no_target_params": OF_DQN,
    "test_sde.py::test_sde_check": SDE,
    "test_sde.py::test_only_sde_squashed": SDE,
    "test_sde.py::test_state_dependent_noise": SDE,
    "test_spaces.py::test_sde_multi_dim": SDE,
    "test_spaces.py::test_multidim_binary_not_supported": DISCRETE,
    "test_spaces.py::test_action_spaces": DISCRETE,
    "test_spaces.py::test_discrete_obs_space": DISCRETE,
    **dict.fromkeys(
        [
            f"test_train_eval_mode.py::test_{name}"
            for name in (
                *("dqn_train_with_batch_norm", "td3_train_with_batch_norm", "sac_train_with_batch_norm"),
                *("a2c_ppo_train_with_batch_norm", "offpolicy_collect_rollout_batch_norm"),
                *("a2c_ppo_collect_rollouts_with_batch_norm", "predict_with_dropout_batch_norm"),
            )
        ],
        EXTRACTOR,
    ),
    "test_vec_envs.py::test_video_recorder": NORMALISED,
    "test_vec_extract_dict_obs.py::test_vec_with_ppo": IMAGES,
    "test_vec_normalize.py::test_her_normalization": NORMALISED,
    "test_vec_normalize.py::test_offpolicy_normalization": NORMALISED,
}
"""Tests that ask for what there is not here on purpose, as ``file::function``, and what that is."""

REPLACES = {"test_run.py::test_offpolicy_multi_env": "TD3", "test_her.py::test_multiprocessing": "TD3"}
"""Tests in which another algorithm than the first of :data:`SB3` is replaced: with SAC this one uses gSDE."""


RANDOM_WEIGHTS = ("test_her.py::test_save_load", "test_save_load.py::test_save_load")
"""Tests that put random numbers in the place of all tensors; the low level is an MLP there, since a circuit's wiring is
among its tensors, and weights of another wiring are refused."""
