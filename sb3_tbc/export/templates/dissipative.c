
/* x <- (x + eta tanh(W u + U x + b)) / (1 + eta K), sub-step after sub-step; there is no closed form. */
void tbc_low_mean(float membrane[TBC_STATE + 1], const float seen[TBC_LOW_INPUT], int closed_form,
                  float mean[TBC_ACTION])
{
    tbc_real x[TBC_STATE], next[TBC_STATE], drive[TBC_STATE];
    int a, i, k, step;
    (void)closed_form;
    for (i = 0; i < TBC_STATE; ++i) {
        tbc_real sum = 0;
        for (k = TBC_INPUT_BEGIN(i); k < TBC_INPUT_BEGIN(i + 1); ++k) {
            sum += input_weight[k] * seen[TBC_INPUT_PRE(i, k)];
        }
        x[i] = membrane[i];
        drive[i] = input_bias[i] + TBC_INPUT_WEIGHT_STEP(i) * sum;
    }
    for (step = 0; step < TBC_SUB_STEPS; ++step) {
        for (i = 0; i < TBC_STATE; ++i) {
            tbc_real sum = 0;
            for (k = TBC_RECURRENT_BEGIN(i); k < TBC_RECURRENT_BEGIN(i + 1); ++k) {
                sum += recurrent_weight[k] * x[TBC_RECURRENT_PRE(i, k)];
            }
            next[i] = (x[i] + TBC_ETA * TBC_TANH(drive[i] + TBC_RECURRENT_WEIGHT_STEP(i) * sum)) * shrink[i];
        }
        memcpy(x, next, sizeof x);
    }
    for (a = 0; a < TBC_ACTION; ++a) {
        tbc_real sum = 0;
        for (i = 0; i < TBC_STATE; ++i) {
            sum += readout[a * TBC_STATE + i] * x[i];
        }
        mean[a] = (float)(readout_bias[a] + TBC_READOUT_STEP(a) * sum);
    }
    for (i = 0; i < TBC_STATE; ++i) {
        membrane[i] = (float)x[i];
    }
}
