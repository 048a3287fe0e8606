
static tbc_real logistic(tbc_real x)
{
    return 1 / (1 + TBC_EXP(-x));
}

/* What the inputs contribute to numerator and denominator; constant over the sub-steps of one control step. */
static void circuit_drive(const float *seen, tbc_real *weighted, tbc_real *total)
{
@PAPER@
    tbc_real released[TBC_SENSORY];
    int i, k;
    for (i = 0; i < TBC_SENSORY; ++i) {
        released[i] = logistic(sensory_gain[i] * seen[i] - sensory_threshold[i]);
    }
    for (i = 0; i < TBC_STATE; ++i) {
        tbc_real w = rest_weighted[i], g = rest_total[i];
        for (k = sensory_begin[i]; k < sensory_begin[i + 1]; ++k) {
            w += sensory_weighted[k] * released[sensory_pre[k]];
            g += sensory_total[k] * released[sensory_pre[k]];
        }
        weighted[i] = w;
        total[i] = g;
    }
@END@
@LEAN@
    int i, k;
    for (i = 0; i < TBC_STATE; ++i) {
        weighted[i] = rest_weighted[i];
        total[i] = rest_total[i];
    }
@END@
    for (i = 0; i < TBC_INTER; ++i) {
        tbc_real current = current_bias[i];
        for (k = current_begin[i]; k < current_begin[i + 1]; ++k) {
            current += current_weight[k] * seen[current_pre[k]];
        }
        weighted[i] += input_conductance[i] * (1 - 2 * logistic(-2 * current)); /* tanh */
    }
}

/* Adds what the neurons release to numerator and denominator of neuron i. */
static inline void circuit_receive(int i, const tbc_real *released, tbc_real *weighted, tbc_real *total)
{
    tbc_real w = *weighted, g = *total; /* in registers: through the pointers every sum would go to memory */
    int k;
    for (k = recurrent_begin[i]; k < recurrent_begin[i + 1]; ++k) {
@PAPER@
        w += recurrent_weighted[k] * released[recurrent_pre[k]];
        g += recurrent_total[k] * released[recurrent_pre[k]];
@END@
@LEAN@
        const tbc_real weight = recurrent_weighted[k] * released[recurrent_pre[k]];
        w += weight;
        g += weight < 0 ? -weight : weight; /* the conductance is the weight's size */
@END@
    }
    *weighted = w;
    *total = g;
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

void tbc_low_mean(float membrane[TBC_STATE + 1], const float seen[TBC_LOW_INPUT], int closed_form,
                  float mean[TBC_ACTION])
{
    tbc_real v[TBC_STATE], weighted[TBC_STATE], total[TBC_STATE];
    int a, i;
    for (i = 0; i < TBC_STATE; ++i) {
        v[i] = membrane[i];
    }
    circuit_drive(seen, weighted, total);
    if (closed_form) {
        circuit_relax(v, weighted, total);
    } else {
        circuit_integrate(v, weighted, total);
    }
    for (a = 0; a < TBC_ACTION; ++a) {
        tbc_real sum = readout_bias[a];
        for (i = 0; i < TBC_STATE; ++i) {
            sum += readout[a * TBC_STATE + i] * v[i];
        }
        mean[a] = (float)sum;
    }
    for (i = 0; i < TBC_STATE; ++i) {
        membrane[i] = (float)v[i];
    }
}
