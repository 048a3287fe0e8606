/* Two-level policy for @TASK@, exported from sb3_tbc. C99, no allocation, no dependency beyond the standard headers.
 *
 *     tbc_state state;
 *     tbc_reset(&state);
 *     for each control step:
 *         if (!tbc_step(&state, observation, achieved_goal, desired_goal, 0, action)) {
 *             something is NaN or infinite: stop safely
 *         }
 *
 * The fifth argument chooses how a conductance circuit is evaluated: 0 integrates its sub-steps as in training, 1 takes the
 * closed form. To use the functions from another file, define TBC_DECLARATIONS_ONLY there and include this one.
 * TBC_LOW_LEVEL_ONLY leaves out the high level, TBC_INTEGRATED_ONLY the closed form; the fifth argument has no effect then.
 * Both levels work in double precision, as predict does; define TBC_SINGLE everywhere for processors that have single
 * precision only, at the price of the fourth digit of an action. Compile without -ffast-math, which takes NaN for impossible.
 */
#ifndef @GUARD@
#define @GUARD@
#ifdef TBC_POLICY
#error "Two policies in one source file: the second would be the first. Give each a file and function names of its own."
#endif
#define TBC_POLICY

@SIZES@

#ifdef TBC_SINGLE
typedef float tbc_real;
#else
typedef double tbc_real;
#endif

typedef struct {
    tbc_real subgoal[TBC_SUBGOAL];    /* task units */
    double time_budget;               /* control steps */
    int elapsed;                      /* control steps since the option began; -1: no option yet */
    float membrane[TBC_STATE + 1];    /* potentials; the last entry is unused */
} tbc_state;

#ifdef __cplusplus
extern "C" {
#endif

/* Start of an episode. */
void tbc_reset(tbc_state *state);

/* One control step; the action is in the environment's units. Returns 1; or 0 where something that a level is given or
 * answers is NaN or infinite: the action is NaN then, and the state is left as it was, so that the next step may go on. */
int tbc_step(tbc_state *state, const float observation[TBC_OBSERVATION],
             const float achieved_goal[TBC_ACHIEVED_GOAL], const float desired_goal[TBC_DESIRED_GOAL],
             int closed_form, float action[TBC_ACTION]);

/* The low level alone: means before squashing, from what it sees (local state, subgoal, remaining time in [0, 1]). */
void tbc_low_mean(float membrane[TBC_STATE + 1], const float seen[TBC_LOW_INPUT], int closed_form,
                  float mean[TBC_ACTION]);

#ifdef __cplusplus
}
#endif

#ifndef TBC_DECLARATIONS_ONLY

#include <math.h>
#include <string.h>

#ifdef TBC_SINGLE
#define TBC_EXP expf
#define TBC_TANH tanhf
#else
#define TBC_EXP exp
#define TBC_TANH tanh
#endif

/* ---------------------------------------------------------------- low level */

@LOW_DATA@@LOW_CODE@
#ifndef TBC_LOW_LEVEL_ONLY

/* ---------------------------------------------------------------- high level and options */

@HIGH_DATA@
static tbc_real squash(float mean, float bound)
{
    return TBC_TANH(mean > bound ? bound : mean < -bound ? -bound : mean); /* fminf would make a number of NaN */
}

/* Subgoal-space point of a state; only filled in where options may end on reaching their subgoal. */
static void subgoal_point(const float *entries, tbc_real here[TBC_SUBGOAL])
{
    memset(here, 0, TBC_SUBGOAL * sizeof(tbc_real));
@ACHIEVED@
}

static int reached(const tbc_real *here, const tbc_real *subgoal)
{
@REACHED@
}

static void begin_option(tbc_state *state, const float *observation, const float *achieved_goal,
                         const float *desired_goal)
{
    float unit[@UNITS@];
    int i;
@HIGH_INPUTS@
    high_network(seen, unit);
    for (i = 0; i < TBC_SUBGOAL; ++i) {
        const double half = 0.5 * ((double)(float)squash(unit[i], TBC_HIGH_BOUND) + 1.0);
        state->subgoal[i] = (tbc_real)(subgoal_low[i] + half * (subgoal_high[i] - subgoal_low[i]));
    }
    state->time_budget = @BUDGET@;
    state->elapsed = 0;
}

void tbc_reset(tbc_state *state)
{
    memset(state, 0, sizeof *state);
    state->elapsed = -1;
}

int tbc_step(tbc_state *state, const float observation[TBC_OBSERVATION],
             const float achieved_goal[TBC_ACHIEVED_GOAL], const float desired_goal[TBC_DESIRED_GOAL],
             int closed_form, float action[TBC_ACTION])
{
    float entries[TBC_OBSERVATION + TBC_ACHIEVED_GOAL], seen[TBC_LOW_INPUT], mean[TBC_ACTION];
    tbc_real here[TBC_SUBGOAL];
    tbc_state next = *state;
    const int n_local = @LOCAL@;
    const int started = next.elapsed < 0;
    int i, over, finite;

    memcpy(entries, observation, TBC_OBSERVATION * sizeof(float));
    memcpy(entries + TBC_OBSERVATION, achieved_goal, TBC_ACHIEVED_GOAL * sizeof(float));
    subgoal_point(entries, here);
    over = started || next.elapsed >= next.time_budget@EVENT@
        || (next.elapsed >= TBC_DT_MIN && reached(here, next.subgoal));
    if (@FORGET@) {
        memset(next.membrane, 0, sizeof next.membrane);
    }
    if (over) {
        begin_option(&next, observation, achieved_goal, desired_goal);
    }
    for (i = 0; i < n_local; ++i) {
        seen[i] = entries[local_entry[i]];
    }
    for (i = 0; i < TBC_SUBGOAL; ++i) {
        seen[n_local + i] = (float)@ASKED@;
    }@REMAINING@
    tbc_low_mean(next.membrane, seen, closed_form, mean);
    finite = isfinite(next.time_budget) ? 1 : 0;
    for (i = 0; i < TBC_LOW_INPUT; ++i) {
        finite = finite && isfinite(seen[i]);
    }
    for (i = 0; i < TBC_ACTION; ++i) {
        const float half = 0.5f * ((float)squash(mean[i], TBC_LOW_BOUND) + 1.0f);
        const float wanted = action_low[i] + half * (action_high[i] - action_low[i]);
        action[i] = wanted > action_high[i] ? action_high[i] : wanted; /* rounded, it may lie above the bound */
        finite = finite && isfinite(action[i]);
    }
    if (!finite) {
        for (i = 0; i < TBC_ACTION; ++i) {
            action[i] = NAN;
        }
        return 0;
    }
    next.elapsed += 1;
    *state = next;
    return 1;
}

#endif /* TBC_LOW_LEVEL_ONLY */
#endif /* TBC_DECLARATIONS_ONLY */
#endif /* @GUARD@ */
