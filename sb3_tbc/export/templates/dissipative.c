
/* x <- (x + eta tanh(W u + U x + b)) / (1 + eta K), sub-step after sub-step; there is no closed form. */
void tbc_low_mean(float membrane[TBC_STATE + 1], const float seen[TBC_LOW_INPUT], int closed_form,
                  float mean[TBC_ACTION])
{
    tbc_real x[TBC_STATE], next[TBC_STATE], drive[TBC_STATE];
    int a, i, k, step;
    (void)closed_form;
    for (i = 0; i < TBC_STATE; ++i) {
        x[i] = membrane[i];
        drive[i] = input_bias[i];
        for (k = input_begin[i]; k < input_begin[i + 1]; ++k) {
            drive[i] += input_weight[k] * seen[input_pre[k]];
        }
    }
    for (step = 0; step < TBC_SUB_STEPS; ++step) {
        for (i = 0; i < TBC_STATE; ++i) {
            tbc_real force = drive[i];
            for (k = recurrent_begin[i]; k < recurrent_begin[i + 1]; ++k) {
                force += recurrent_weight[k] * x[recurrent_pre[k]];
            }
            next[i] = (x[i] + TBC_ETA * TBC_TANH(force)) * shrink[i];
        }
        memcpy(x, next, sizeof x);
    }
    for (a = 0; a < TBC_ACTION; ++a) {
        tbc_real sum = readout_bias[a];
        for (i = 0; i < TBC_STATE; ++i) {
            sum += readout[a * TBC_STATE + i] * x[i];
        }
        mean[a] = (float)sum;
    }
    for (i = 0; i < TBC_STATE; ++i) {
        membrane[i] = (float)x[i];
    }
}
