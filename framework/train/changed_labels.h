// Labels that are set while a session trains: images of labels, and clicks.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "labels/clicks.h"
#include "train/ray_source.h"
#include "train/session.h"

namespace semfield {

/// What Trainer::set_labels and set_clicks do. Each changes everything or, where it throws, nothing.
class ChangedLabels {
 public:
  /// Borrows both.
  ChangedLabels(Session& session, RaySource& rays);
  void set(int frame, std::vector<std::int16_t> labels);
  void set_clicks(const Annotations& clicks, std::span<const int> frames);
  /// Of the labels that were set, not clicked, for checkpoints; "" where none were.
  std::string name() const;
  /// Events whose labels train; none: the session has no clicks.
  const std::optional<EventsKnown>& clicks() const { return clicks_; }

 private:
  void require_drawn(int frame) const;
  template <class Paint>
  void replace(std::span<const int> frames, const Paint& paint);

  Session& session_;
  RaySource& rays_;
  std::optional<EventsKnown> clicks_;
  std::vector<bool> was_set_;  // by frame: its labels are those of set
};

}  // namespace semfield
