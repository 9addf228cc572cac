"""The card of driving."""

from ppl_jax.cards import EnvCard, ExpertCard

# What a clone lacks is situations, not steps: many maps, and of its demonstrations the one of
# twelve that it was worst at. Slow and safe, it has hardly anything left to earn, so the cost
# weighs five times the reward; left to itself it unlearns what it was shown, so it stays guided.
_EXPERT = ExpertCard(
    config={
        "total_steps": 500_000,
        "hidden": (288, 288, 288),
        "demonstrations": 14_400_000,
        "demonstration_stride": 12,
        "demonstration_rounds": 24,
        "cloning_updates": 72_000,
        "critic_batches": 10,
        "guided": True,
    },
    hparams={
        "learning_rate": 1e-4,
        "target_kl": 0.01,
        "discount": 0.99,
        "cost_discount": 0.98,
        "cost_limit": 0.2,
        "initial_multiplier": 5.0,
        "lagrangian_lr": 0.0,
        "success_bonus": 20.0,
        "initial_std": 0.08,
        "final_std": 0.05,
        "demonstration_noise": 0.1,
        "guidance_weight": 0.5,
    },
    scenarios=8000,
    teacher="cautious",
)

# "tuning" is for choosing settings: the scenarios of training and twice as many unseen ones;
# "confirmation" for reporting them: the held-out ones and more of their kind
_SETS = {
    "tuning": (*range(100, 150), *range(2000, 2100)),
    "confirmation": (*range(1000, 1050), *range(3000, 3200)),
}

DRIVING = EnvCard(
    title="Driving",
    summary="A car drives to the end of its route, through traffic and obstacles (MetaDrive).",
    control_rate=10.0,
    actions=("steering", "throttle or brake"),
    view="road",
    predictors=("simulator", "kinematic"),
    experts=("scripted", "cautious"),
    neural_expert=True,
    demonstrations=20_000,
    warm_up=600,
    # a drift off the lane is taken over while the way back is still short
    preset_settings={"default": {"min_clearance": 0.6}},
    sets=_SETS,
    step_ms=5.0,
    expert=_EXPERT,
)
