// One side of a leave-out pair: a session that trains, and what both sides of a pair are measured by.
#pragma once

#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "session/trainer.h"
#include "studies/leave_out_pairs.h"

namespace semfield {

/// CPU seconds of this process.
double processor_s();

/// Not movable: the trainer borrows. One thread, so that CPU time is the step's.
class LeaveOutSide {
 public:
  LeaveOutSide(const LeaveOutPair& pair, const std::vector<std::string>& own, const PairOptions& options,
               Registry& registry, const std::string& config_path, int seed);
  LeaveOutSide(const LeaveOutSide&) = delete;
  LeaveOutSide& operator=(const LeaveOutSide&) = delete;

  void train(int steps);
  Pipeline<float>& pipeline() const { return *session.pipeline; }
  std::vector<int> test_frames() const { return session.scene.frames_of(Split::test); }
  /// Held by scene, parameters and activations.
  std::int64_t bytes() const;
  SplitScore score(int frames) const;

  Session session;
  std::unique_ptr<RaySource> rays;
  std::unique_ptr<Trainer> trainer;
};

/// Alternating rounds of both sides, CPU time of each; `repeats` units of work a round.
PairCost measure_sides(const char* of, int rounds, int repeats, const std::function<void()>& out,
                       const std::function<void()>& kept);

/// SHA-256 of values and moments of the learned tensors that `other` has too, and how many they are.
std::string hash_of_shared(const Pipeline<float>& of, Pipeline<float>& other, int& shared);
/// "SHA-256 ... on both sides (of)".
std::string hashes_text(const std::string& a, const std::string& b, const std::string& of);
/// Values of the tensors that both have.
void copy_tensors(Pipeline<float>& from, Pipeline<float>& to);

/// Rows that no ray met: unchanged since they were made; the time that a dense update would add to a step.
PairResult compare_rows(const PairOptions& options, LeaveOutSide& side, LeaveOutSide& fresh);
/// Training with and without evaluations between its steps.
PairResult compare_evaluation(const PairOptions& options, LeaveOutSide& out, LeaveOutSide& kept);
/// What looking for values that are not finite costs a step.
PairResult cost_of_checks(const PairOptions& options, LeaveOutSide& side);
/// What the image library costs when it is loaded; /proc/self/maps before and after.
PairResult cost_of_image_library();
/// True when a file of the process's memory map has `name` in its path.
bool is_mapped(const std::string& name);

}  // namespace semfield
