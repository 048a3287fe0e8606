
static float logistic(float x)
{
    return 1.0f / (1.0f + expf(-x));
}

/* What the inputs contribute to numerator and denominator; constant over the sub-steps of one control step. */
static void circuit_drive(const float *seen, float *weighted, float *total)
{
    float released[TBC_SENSORY];
    int i, k;
    for (i = 0; i < TBC_SENSORY; ++i) {
        released[i] = logistic(sensory_gain[i] * seen[i] - sensory_threshold[i]);
    }
    for (i = 0; i < TBC_STATE; ++i) {
        float w = rest_weighted[i], g = rest_total[i];
        for (k = sensory_begin[i]; k < sensory_begin[i + 1]; ++k) {
            w += sensory_weighted[k] * released[sensory_pre[k]];
            g += sensory_total[k] * released[sensory_pre[k]];
        }
        weighted[i] = w;
        total[i] = g;
    }
    for (i = 0; i < TBC_INTER; ++i) {
        float current = current_bias[i];
        for (k = current_begin[i]; k < current_begin[i + 1]; ++k) {
            current += current_weight[k] * seen[current_pre[k]];
        }
        weighted[i] += input_conductance[i] * tanhf(current);
    }
}

/* Adds what the neurons release to numerator and denominator of neuron i. */
static void circuit_receive(int i, const float *released, float *weighted, float *total)
{
    int k;
    for (k = recurrent_begin[i]; k < recurrent_begin[i + 1]; ++k) {
        *weighted += recurrent_weighted[k] * released[recurrent_pre[k]];
        *total += recurrent_total[k] * released[recurrent_pre[k]];
    }
}

static void circuit_integrate(float *v, const float *weighted, const float *total)
{
    float released[TBC_PRESYNAPTIC];
    int i, k;
    for (k = 0; k < TBC_SUB_STEPS; ++k) {
        for (i = 0; i < TBC_PRESYNAPTIC; ++i) {
            released[i] = logistic(gain[i] * v[i] - threshold[i]);
        }
        for (i = 0; i < TBC_STATE; ++i) {
            const float inertia = capacitance[i] * TBC_SUB_STEPS;
            float w = weighted[i], g = total[i];
            circuit_receive(i, released, &w, &g);
            v[i] = (v[i] * inertia + w) / (g + inertia);
        }
    }
}

/* V(t) = (V0 - A) exp(-(w_tau + f) t) + A, layer after layer. */
static void circuit_relax(float *v, const float *weighted, const float *total)
{
    float released[TBC_PRESYNAPTIC];
    int i, layer, begin = 0;
    for (i = 0; i < TBC_PRESYNAPTIC; ++i) {
        released[i] = logistic(gain[i] * v[i] - threshold[i]);
    }
    for (layer = 0; layer < 3; ++layer) {
        for (i = begin; i < layer_end[layer]; ++i) {
            float w = weighted[i], g = total[i];
            circuit_receive(i, released, &w, &g);
            v[i] -= (w / g - v[i]) * expm1f(-g / capacitance[i]);
        }
        for (i = begin; i < layer_end[layer] && i < TBC_PRESYNAPTIC; ++i) {
            released[i] = logistic(gain[i] * v[i] - threshold[i]);
        }
        begin = layer_end[layer];
    }
}

void tbc_low_mean(float membrane[TBC_STATE + 1], const float seen[TBC_LOW_INPUT], int closed_form,
                  float mean[TBC_ACTION])
{
    float weighted[TBC_STATE], total[TBC_STATE];
    int a, i;
    circuit_drive(seen, weighted, total);
    if (closed_form) {
        circuit_relax(membrane, weighted, total);
    } else {
        circuit_integrate(membrane, weighted, total);
    }
    for (a = 0; a < TBC_ACTION; ++a) {
        float sum = readout_bias[a];
        for (i = 0; i < TBC_STATE; ++i) {
            sum += readout[a * TBC_STATE + i] * membrane[i];
        }
        mean[a] = sum;
    }
}
