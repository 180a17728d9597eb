// The temperature of a labelling session's class probabilities, by clicks that were held back [Guo17, Sec. 4.2].
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

namespace semfield {

inline constexpr int kCalibrationFolds = 5;

/// A click that was held back: its class probabilities by what was learned from the other clicks, and how much of the
/// surface it stands for.
struct HeldBack {
  std::vector<float> probability;
  std::size_t truth = 0;
  double counts = 0;
};

/// The fold of each click, by the classes of the clicks: those of a class are dealt out in turn. -1: the class has too
/// few clicks, so that without one it is learned from hardly any, and what is found then says nothing of what is
/// learned from all.
std::vector<int> calibration_folds(std::span<const std::int16_t> classes);

/// The temperature of the largest posterior: the likelihood of the clicks, each counted for its surface and a tenth of
/// them taken for wrong, and a prior around 1. None where they do not settle one: too few of them, or an optimum at a
/// bound.
std::optional<double> fit_temperature(std::span<const HeldBack> held);

}  // namespace semfield
