"""Tests of Stable-Baselines3 that are not simply to pass with our agents, and those that need a word of care."""

from __future__ import annotations

IMAGES = "images: a level sees a flat vector"
EXTRACTOR = "features extractors with batch norm or dropout: a level sees a flat vector"
SDE = "gSDE: levels explore as SAC does without it"
BUFFER = "replay buffers of SB3's own, and what lies in them"
NORMALISED = "VecNormalize: it would move the subgoal space"
OPTIMISER = "optimisers: both levels use Adam"
REFUSED = {
    "test_cnn.py::test_cnn": IMAGES,
    "test_cnn.py::test_vec_transpose_skip": IMAGES,
    "test_cnn.py::test_features_extractor_target_net": IMAGES,
    "test_cnn.py::test_image_like_input": IMAGES,
    "test_custom_policy.py::test_custom_optimizer": OPTIMISER,
    "test_dict_env.py::test_consistency": "policies for arrays: goal observations are dictionaries",
    "test_dict_env.py::test_vec_normalize": NORMALISED,
    "test_gae.py::test_infinite_horizon": BUFFER,
    "test_her.py::test_goal_selection_strategy": "action noise: levels explore as SAC does",
    "test_her.py::test_save_load_replay_buffer": BUFFER,
    "test_n_step_replay.py::test_run": "returns of n steps",
    "test_run.py::test_train_freq_fail": "train_freq: updates follow finished episodes",
    "test_run.py::test_offpolicy_multi_env": "train_freq: updates follow finished episodes",
    "test_save_load.py::test_save_load_replay_buffer": BUFFER,
    "test_save_load.py::test_save_load_policy": "a policy's own file: both levels are saved with their agent",
    "test_sde.py::test_state_dependent_noise": SDE,
    "test_spaces.py::test_sde_multi_dim": SDE,
    "test_spaces.py::test_action_spaces": "actions with several dimensions",
    "test_train_eval_mode.py::test_sac_train_with_batch_norm": EXTRACTOR,
    "test_vec_normalize.py::test_her_normalization": NORMALISED,
    "test_vec_normalize.py::test_offpolicy_normalization": NORMALISED,
}
"""Tests of SAC that ask for what there is not here on purpose, as ``file::function``, and what that is.

They are run with all arguments as they are; each case must pass or end with an error of ours, of one line.
"""

UNTOUCHED = (
    "test_buffers.py::test_custom_rollout_buffer",
    "test_callbacks.py::test_eval_friendly_error",
    "test_callbacks.py::test_checkpoint_additional_info",
    "test_cnn.py::test_channel_first_env",
    "test_custom_policy.py::test_tf_like_rmsprop_optimizer",
    "test_custom_policy.py::test_dqn_custom_policy",
    "test_distributions.py::test_squashed_gaussian",
    "test_gae.py::test_gae_computation",
    "test_her.py::test_performance_her",
    "test_identity.py::test_discrete",
    "test_logger.py::test_sb3_import_without_optional_deps",
    "test_predict.py::test_dqn_epsilon_greedy",
    "test_run.py::test_advantage_normalization",
    "test_run.py::test_ppo",
    "test_run.py::test_ppo_warnings",
    "test_run.py::test_warn_dqn_multi_env",
    "test_save_load.py::test_save_load_env_cnn",
    "test_save_load.py::test_save_load_q_net",
    "test_save_load.py::test_load_invalid_object",
    "test_save_load.py::test_cast_lr_schedule",
    "test_save_load.py::test_save_load_backward_compatible",
    "test_save_load.py::test_save_load_clip_range_portable",
    "test_save_load.py::test_dqn_target_update_interval",
    "test_save_load.py::test_save_load_net_arch_none",
    "test_save_load.py::test_save_load_no_target_params",
    "test_sde.py::test_sde_check",
    "test_sde.py::test_only_sde_squashed",
    "test_spaces.py::test_multidim_binary_not_supported",
    "test_spaces.py::test_discrete_obs_space",
    "test_train_eval_mode.py::test_dqn_train_with_batch_norm",
    "test_train_eval_mode.py::test_td3_train_with_batch_norm",
    "test_train_eval_mode.py::test_a2c_ppo_train_with_batch_norm",
    "test_train_eval_mode.py::test_a2c_ppo_collect_rollouts_with_batch_norm",
    "test_vec_envs.py::test_video_recorder",
    "test_vec_extract_dict_obs.py::test_vec_with_ppo",
)
"""Tests without SAC, about what another algorithm of SB3 has: they are run as they are, beside our package."""

BY_CLASS = "looks its agents up by class, and ours are not among them; its features extractors are refused"
LEFT_OUT = {
    "test_dict_env.py::test_dict_vec_framestack": "names channel orders of entries that goal observations do not have",
    "test_train_eval_mode.py::test_offpolicy_collect_rollout_batch_norm": BY_CLASS,
    "test_train_eval_mode.py::test_predict_with_dropout_batch_norm": BY_CLASS,
    "test_save_load.py::test_save_load_large_model": "marked expensive, and left out by SB3 too",
    "test_identity.py::test_continuous": "how fast one level learns; the goal is another one in every step",
}
"""Tests that are not run, and why."""

REPLACES = {"test_run.py::test_offpolicy_multi_env": "TD3", "test_her.py::test_multiprocessing": "TD3"}
"""Tests in which another algorithm than the first of :data:`SB3` is replaced: with SAC this one uses gSDE."""

RANDOM_WEIGHTS = (
    "test_her.py::test_save_load",
    "test_save_load.py::test_save_load",
    "test_save_load.py::test_save_load_policy",
)
"""Tests that put random numbers in the place of all tensors; the low level is an MLP there, since a circuit's wiring is
among its tensors, and weights of another wiring are refused."""
