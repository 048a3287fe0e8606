
static tbc_real logistic(tbc_real x)
{
    return 1 / (1 + TBC_EXP(-x));
}

/* What the inputs contribute to numerator and denominator; constant over the sub-steps of one control step. */
static void circuit_drive(const float *seen, tbc_real *weighted, tbc_real *total)
{
    tbc_real scaled[TBC_LOW_INPUT];
@PAPER@
    tbc_real released[TBC_SENSORY];
@END@
    int i, k;
    for (i = 0; i < TBC_LOW_INPUT; ++i) {
        scaled[i] = input_gain[i] * seen[i];
    }
@PAPER@
    for (i = 0; i < TBC_SENSORY; ++i) {
        released[i] = logistic(sensory_gain[i] * scaled[i] - sensory_threshold[i]);
    }
    for (i = 0; i < TBC_STATE; ++i) {
        tbc_real w = 0, g = 0;
        for (k = TBC_SENSORY_BEGIN(i); k < TBC_SENSORY_BEGIN(i + 1); ++k) {
            w += sensory_weighted[k] * released[TBC_SENSORY_PRE(i, k)];
            g += sensory_total[k] * released[TBC_SENSORY_PRE(i, k)];
        }
        weighted[i] = rest_weighted[i] + TBC_SENSORY_WEIGHTED_STEP(i) * w;
        total[i] = rest_total[i] + TBC_SENSORY_TOTAL_STEP(i) * g;
    }
@END@
@LEAN@
    for (i = 0; i < TBC_STATE; ++i) {
        weighted[i] = rest_weighted[i];
        total[i] = rest_total[i];
    }
@END@
    for (i = 0; i < TBC_INTER; ++i) {
        tbc_real sum = 0, current;
        for (k = TBC_CURRENT_BEGIN(i); k < TBC_CURRENT_BEGIN(i + 1); ++k) {
            sum += current_weight[k] * scaled[TBC_CURRENT_PRE(i, k)];
        }
        current = current_bias[i] + TBC_CURRENT_WEIGHT_STEP(i) * sum;
        weighted[i] += input_conductance[i] * (1 - 2 * logistic(-2 * current)); /* tanh */
    }
}

/* Adds what the neurons release to numerator and denominator of neuron i. */
static inline void circuit_receive(int i, const tbc_real *released, tbc_real *weighted, tbc_real *total)
{
    tbc_real w = 0, g = 0;
    int k;
    for (k = TBC_RECURRENT_BEGIN(i); k < TBC_RECURRENT_BEGIN(i + 1); ++k) {
@PAPER@
        w += recurrent_weighted[k] * released[TBC_RECURRENT_PRE(i, k)];
        g += recurrent_total[k] * released[TBC_RECURRENT_PRE(i, k)];
@END@
@LEAN@
        const tbc_real weight = recurrent_weighted[k] * released[TBC_RECURRENT_PRE(i, k)];
        w += weight;
        g += weight < 0 ? -weight : weight; /* the conductance is the weight's size */
@END@
    }
    *weighted += TBC_RECURRENT_WEIGHTED_STEP(i) * w;
@PAPER@
    *total += TBC_RECURRENT_TOTAL_STEP(i) * g;
@END@
@LEAN@
    *total += TBC_RECURRENT_WEIGHTED_STEP(i) * g;
@END@
}

static void circuit_integrate(tbc_real *v, const tbc_real *weighted, const tbc_real *total)
{
    tbc_real released[TBC_PRESYNAPTIC];
    int i, k;
    for (k = 0; k < TBC_SUB_STEPS; ++k) {
        for (i = 0; i < TBC_PRESYNAPTIC; ++i) {
            released[i] = logistic(gain[i] * v[i] - threshold[i]);
        }
        for (i = 0; i < TBC_STATE; ++i) {
            const tbc_real inertia = capacitance[i] * TBC_SUB_STEPS;
            tbc_real w = weighted[i], g = total[i];
            circuit_receive(i, released, &w, &g);
            v[i] = (v[i] * inertia + w) / (g + inertia);
        }
    }
}

#ifndef TBC_INTEGRATED_ONLY
/* V(t) = (V0 - A) exp(-(w_tau + f) t) + A, each neuron hearing where those before it have come to, and where a
 * loop is opened, where the others were. */
static void circuit_relax(tbc_real *v, const tbc_real *weighted, const tbc_real *total)
{
    tbc_real released[TBC_PRESYNAPTIC] = {0};
    int i, k;
    for (k = 0; k < TBC_LOOPS; ++k) {
        i = heard_early[k];
        released[i] = logistic(gain[i] * v[i] - threshold[i]);
    }
    for (k = 0; k < TBC_STATE; ++k) {
        tbc_real w, g;
        i = relaxation_order[k];
        w = weighted[i];
        g = total[i];
        circuit_receive(i, released, &w, &g);
        v[i] = w / g + (v[i] - w / g) * TBC_EXP(-g / capacitance[i]);
        if (i < TBC_PRESYNAPTIC) {
            released[i] = logistic(gain[i] * v[i] - threshold[i]);
        }
    }
}
#endif

void tbc_low_mean(float membrane[TBC_STATE + 1], const float seen[TBC_LOW_INPUT], int closed_form,
                  float mean[TBC_ACTION])
{
    tbc_real v[TBC_STATE], weighted[TBC_STATE], total[TBC_STATE];
    int a, i;
    for (i = 0; i < TBC_STATE; ++i) {
        v[i] = membrane[i];
    }
    circuit_drive(seen, weighted, total);
#ifdef TBC_INTEGRATED_ONLY
    (void)closed_form;
    circuit_integrate(v, weighted, total);
#else
    if (closed_form) {
        circuit_relax(v, weighted, total);
    } else {
        circuit_integrate(v, weighted, total);
    }
#endif
    for (a = 0; a < TBC_ACTION; ++a) {
        tbc_real sum = 0;
        for (i = 0; i < TBC_STATE; ++i) {
            sum += readout[a * TBC_STATE + i] * v[i];
        }
        mean[a] = (float)(readout_bias[a] + TBC_READOUT_STEP(a) * sum);
    }
    for (i = 0; i < TBC_STATE; ++i) {
        membrane[i] = (float)v[i];
    }
}
