// Group D: heads, losses and activations.
#include "loss_cases.h"

namespace semfield::numerics {

namespace {

constexpr Case kCases[] = {
    {"D01", "logit-sweep", "logits up to 1e30 in size, 2 to 1,024 classes", "long double", logit_sweep},
    {"D02", "inf-logit", "one or two infinite or NaN logits", "named error", infinite_logit},
    {"D03", "one-hot-entropy", "probabilities 0 and 1", "0", one_hot_entropy},
    {"D04", "one-class", "a single class", "0", one_class},
    {"D05", "all-void", "1,024 void rays; training steps without a label", "0", all_void},
    {"D06", "one-labelled", "1 labelled ray of 1,024, each normalisation", "long double", one_labelled},
    {"D07", "label-range", "labels C, -2, 255, 65535", "named error", label_range},
    {"D08", "empty-ray", "density 0 along the ray", "1/C, ln C", empty_ray},
    {"D09", "half-opacity", "margin 10 at opacity 1/2, 28 classes", "closed form", half_opacity},
    {"D10", "soft-labels", "sums 0.9, 1.1, 1e-20, 1e20; negative, NaN", "long double", soft_labels},
    {"D11", "detach", "stop_gradient_to_density", "0", detached},
    {"D12", "class-weights", "classes of frequency 0 and 1", "long double", class_weights},
    {"D13", "double-softmax", "a margin of 40 as logits and as probabilities", "closed form", double_softmax},
    {"D14", "sigmoid-sat", "colour layers saturated by up to 1e4", "long double", saturated_sigmoid},
    {"D15", "hdr-target", "targets 1e4, -1, NaN, infinite", "long double", hdr_target},
    {"D16", "density-act", "raw densities -1e4 .. 1e4, three activations", "long double", density_activations},
    {"D17", "exp-88/89", "raw densities 88, 89, 1e4, 1e30", "long double", large_exponents},
    {"D18", "dead-start", "100 seeds from almost no density", "moves or stops", dead_start},

};

}  // namespace

std::span<const Case> loss_cases() { return kCases; }

}  // namespace semfield::numerics
