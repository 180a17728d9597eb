// Semantic loss: cross-entropy of class logits against hard or soft labels; softmax and entropy for rendering.
#pragma once

#include <cstdint>
#include <vector>

#include "config/params.h"
#include "core/view.h"

namespace semfield {

/// What the summed loss of a batch is divided by.
///   mean_labelled  the batch's labelled rays (their total class weight when classes are weighted);
///   sum            1;
///   mean_rays      all rays of the batch, labelled or not.
enum class SemanticNormalisation : std::uint8_t { mean_labelled, sum, mean_rays };

SEMFIELD_CHOICES(SemanticNormalisation, "mean_labelled", "sum", "mean_rays");

/// Labels of R rays: exactly one view is set.
struct SemanticTargets {
  View<const std::int16_t> hard;  ///< [R, 1] class 0..C-1, or -1 (void): no loss
  /// [R, C] probabilities. A row is divided by its sum; a row of zeros is unlabelled; negative or non-finite values are
  /// refused.
  View<const float> soft;
};

struct SemanticLoss {
  double sum = 0;             ///< weighted cross-entropy in nats, before division
  std::int64_t labelled = 0;  ///< rays that carried a label
};

/// Labelled rays of the whole batch or, with class weights [C] (as a row view [1, C]), their total weight: the count
/// that normaliser() wants. Soft rows weigh sum_c p_c weight_c.
double labelled_weight(const SemanticTargets& targets, View<const float> class_weight);

/// Divisor for a batch; 0 when mean_labelled finds no label.
double semantic_normaliser(SemanticNormalisation kind, double labelled_weight, std::int64_t rays);

/// L_s = -sum_r sum_c weight_c p_rc log softmax(s_r)_c / normaliser [Zhi21 Eq. 5], by log-sum-exp from the row maximum.
/// Writes d_logits [R, C] = scale / normaliser * weight-sum * (softmax - p) when not empty; rows without label, and
/// every row when normaliser is 0, get exactly 0. Logits [R, C] must be finite: Error(failure) names ray and class. A
/// hard label outside -1..C-1 is Error(data) naming ray (first_ray + r) and value. class_weight [1, C] or empty.
template <class Real>
SemanticLoss semantic_cross_entropy(View<const Real> logits, const SemanticTargets& targets,
                                    View<const float> class_weight, double normaliser, double scale,
                                    View<Real> d_logits, std::int64_t first_ray = 0);

/// 1 / ln(1.02 + frequency) per class: finite for absent classes (at most 50.5) [Paszke16]. `pixels` per class.
std::vector<float> inverse_log_frequency_weights(const std::vector<std::int64_t>& pixels);

/// probability = softmax(logits), rows of [R, C]; may be the same memory.
template <class Real>
void softmax(View<const Real> logits, View<Real> probability);

/// entropy [R, 1] in nats, H = -sum p ln p of softmax(logits) [R, C]; 0 .. ln C, exactly 0 for a certain row.
template <class Real>
void softmax_entropy(View<const Real> logits, View<Real> entropy);

// Colour loss: squared error over rays and channels.

/// L_p = sum of (c - target)^2 / normaliser [Zhi21 Eq. 4]; the mean takes normaliser = 3 * rays of the whole batch, of
/// which these R rays may be one tile. Returns the sum of squares before division, so that tiles add up; writes d_color
/// = scale * 2 (c - target) / normaliser when d_color is not empty. color, target, d_color [R, 3]. Zero rays: 0. A
/// non-finite colour or target makes the sum non-finite (the caller's check names it); nothing is clamped.
template <class Real>
double photometric_loss(View<const Real> color, View<const float> target, double normaliser, double scale,
                        View<Real> d_color);

}  // namespace semfield
