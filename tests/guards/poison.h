// Plugins of the registry behind a wrapper that spoils one value of one ray: the seam that the library does not have.
#pragma once

#include "session/trainer.h"
#include "tests/session/train_testing.h"

namespace semfield::testing_guards {

/// What the wrappers spoil now. The address is a ray, so that it is the same in a tile, in a whole batch and alone.
struct Poison {
  std::string stage;  ///< "" = nothing: the wrappers pass everything through
  std::string pass;   ///< name of the pass, as its wrappers were given
  float value = 0;
  std::int64_t ray = 0;     ///< in the batch, or in the call that renders
  Vec3d origin, direction;  ///< of that ray
  bool in_training = true;  ///< forward calls of training, or those of rendering and queries
  DomainMap domain;         ///< of the pass
};

/// The poison that every wrapper of this process reads; set between steps.
Poison& poison();

/// Registry of tests/session whose encoders, fields and samplers are also there as "poisoned_NAME".
Registry make_poisoned_registry();

/// A configuration of tests/session with every plugin in its poisoned form.
std::string poisoned(std::string yaml);

/// A run that stands after `steps` clean steps.
struct Subject {
  Subject(const std::string& yaml, Registry& registry, int steps);
  Session session;
  std::unique_ptr<RaySource> rays;
  std::unique_ptr<Trainer> trainer;

  ParamStore<float>& store() { return session.pipeline->store(); }
  /// Puts the address of row `row` of the coming step's batch into poison() and returns what a message must say of it,
  /// found without the ray source: the pixel whose ray has the same bits.
  std::string aim(std::int64_t row);
};

/// Values, moments and states, and the number of steps: all that a failed step may not change.
struct Snapshot {
  explicit Snapshot(const Subject& subject);
  std::map<std::string, std::vector<std::uint32_t>> bits;
  std::int64_t step = 0;
  bool operator==(const Snapshot& other) const = default;
};

/// Sites of one test program: counted by kind, printed at its end.
struct Tally {
  std::map<std::string, std::pair<int, int>> sites;  ///< kind -> tried, caught
  void add(const std::string& kind, bool caught);
  void print() const;
  int total() const;
};
Tally& tally();

/// Tries one step. "" when it went through; else the message.
std::string message_of_step(Trainer& trainer);

/// One site of a training step: the step must fail, say every one of `words`, and change nothing.
void expect_caught(Subject& subject, const std::string& kind, const std::string& site,
                   const std::vector<std::string>& words);

struct BadValue {
  const char* name;
  float value;
};
/// NaN, +inf, -inf.
const std::vector<BadValue>& non_finite_values();

}  // namespace semfield::testing_guards
