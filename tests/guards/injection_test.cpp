// A bad number in every tensor of a run: values, gradients, moments, derived tensors and states, each named.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>

#include "tests/guards/poison.h"

namespace semfield {
namespace {

using namespace testing_guards;

std::string small(std::string yaml) {
  const std::size_t at = yaml.find("rays: ") + 6;
  yaml.replace(at,
               yaml.find(',', at) == std::string::npos ? yaml.find('}', at) - at
                                                       : std::min(yaml.find(',', at), yaml.find('}', at)) - at,
               "16");
  return yaml;
}

std::string element_words(const Tensor<float>& t, std::int64_t element) {
  return "row " + std::to_string(element / t.spec.cols) + ", column " + std::to_string(element % t.spec.cols);
}

bool in_window(const Tensor<float>& t, std::int64_t element, std::int64_t step) {
  const std::int64_t rows = (t.spec.rows + kTableWindows - 1) / kTableWindows;
  return element / t.spec.cols / rows == step % kTableWindows;
}

// An element of a sparse tensor that the coming step touches, in the window that it looks at or out of it; the middle
// of any other.
std::int64_t element_of(Subject& subject, const Tensor<float>& t, bool windowed = true) {
  if (t.spec.role != TensorRole::sparse) return t.size() / 2;
  BatchBuffers batch;
  subject.rays->fill(subject.trainer->step(), batch);
  subject.session.pipeline->gradients(subject.trainer->step(), batch.view(true));
  std::int64_t element = -1;
  for (std::int64_t i = 0; i < t.size() && element < 0; ++i) {
    const bool touched = t.grad.data()[i] != 0;
    element = touched && in_window(t, i, subject.trainer->step()) == windowed ? i : -1;
  }
  subject.store().clear_gradients();
  return element;
}

class TensorInjection : public ::testing::TestWithParam<const char*> {
 protected:
  std::string yaml() const {
    return small(std::string(GetParam()) == "hash" ? testing_train::hash_config() : testing_train::two_pass_config());
  }
};

// Puts `value` at `place`, tries a step, takes it away again.
void spoil(Subject& subject, const std::string& kind, const Tensor<float>& t, float* place, const BadValue& bad,
           std::vector<std::string> words) {
  const float good = *place;
  *place = bad.value;
  words.insert(words.end(), {"'" + t.name + "'", "nothing was changed"});
  expect_caught(subject, kind, t.name + " " + kind + " " + bad.name, words);
  *place = good;
}

TEST_P(TensorInjection, EveryTensorIsNamed) {
  Registry registry = testing_train::make_registry();
  Subject subject(yaml(), registry, 2);
  std::vector<BadValue> with_huge = non_finite_values(), second = non_finite_values();
  with_huge.push_back({"huge", -1e30F});
  second.push_back({"negative", -1});
  for (Tensor<float>& t : subject.store().all()) {
    if (t.spec.role == TensorRole::rearranged) continue;  // made anew from a learned one before each step
    const std::int64_t at = element_of(subject, t);
    ASSERT_GE(at, 0) << t.name << " is touched by no ray";
    const std::string element = element_words(t, at);
    if (!t.learned()) {
      const char* kind = t.spec.role == TensorRole::state ? "value of a state tensor" : "value of a derived tensor";
      for (const BadValue& bad : non_finite_values()) spoil(subject, kind, t, t.value.data() + at, bad, {element});
      continue;
    }
    for (const BadValue& bad : with_huge) {
      spoil(subject, "value", t, t.value.data() + at, bad, {element});
      // A gradient of lane 0 for what lanes sum, else the one that the encoder adds to.
      float* const gradient = t.lanes.size() > 0 ? t.lanes.data() + at : t.grad.data() + at;
      spoil(subject, "gradient", t, gradient, bad, {"the gradient of", element});
      subject.store().clear_gradients();
      spoil(subject, "first moment", t, t.moment1.data() + at, bad, {"the first moment of", element});
    }
    for (const BadValue& bad : second)
      spoil(subject, "second moment", t, t.moment2.data() + at, bad, {"the second moment of", element});
  }
  Subject clean(yaml(), registry, 3);
  subject.trainer->advance();
  EXPECT_TRUE(Snapshot(subject) == Snapshot(clean)) << "a failed step left something behind";
}

// Moments of a table's rows that are not in the step's window: found when their turn comes or when the value that they
// spoil is read, whatever comes first; nothing like it is ever saved.
TEST(TensorInjectionOfTables, MomentsOutOfTheWindowAreFoundInTheirTurn) {
  Registry registry = testing_train::make_registry();
  std::vector<std::string> names;
  Subject any(small(testing_train::hash_config()), registry, 0);
  for (const Tensor<float>& t : any.store().all()) {
    if (t.spec.role == TensorRole::sparse) names.push_back(t.name);
  }
  ASSERT_EQ(names.size(), 6u);
  for (const std::string& name : names) {
    for (const bool second : {false, true}) {
      Subject subject(small(testing_train::hash_config()), registry, 2);
      const Tensor<float>& t = *subject.store().find(name);
      const std::int64_t at = element_of(subject, t, false);
      ASSERT_GE(at, 0);
      (second ? t.moment2 : t.moment1).data()[at] = non_finite_values()[0].value;
      EXPECT_THROW(subject.trainer->check_storable(), Error);
      std::string message;
      for (int i = 0; i < kTableWindows && message.empty(); ++i) message = message_of_step(*subject.trainer);
      const bool caught = message.find("'" + name + "'") != std::string::npos;
      EXPECT_TRUE(caught) << name << ": " << message;
      tally().add("moment out of the window", caught);
    }
  }
}

TEST_P(TensorInjection, NoCheckpointHoldsABadNumber) {
  Registry registry = testing_train::make_registry();
  Subject subject(yaml(), registry, 2);
  EXPECT_NO_THROW(subject.trainer->check_storable());
  for (Tensor<float>& t : subject.store().all()) {
    if (!is_stored(t.spec.role)) continue;
    for (const AlignedBuffer<float>* buffer : {&t.value, &t.moment1, &t.moment2}) {
      if (buffer->size() == 0) continue;
      float& place = buffer->data()[buffer->size() - 1];  // of a table: a row that perhaps no ray ever touched
      const float good = place;
      place = non_finite_values()[0].value;
      std::string message;
      try {
        subject.trainer->check_storable();
      } catch (const Error& error) {
        message = error.what();
      }
      place = good;
      const bool caught = message.find("'" + t.name + "'") != std::string::npos &&
                          message.find(element_words(t, t.size() - 1)) != std::string::npos;
      EXPECT_TRUE(caught) << t.name << ": " << message;
      tally().add("state that would be saved", caught);
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Runs, TensorInjection, ::testing::Values("hash", "two_pass"),
                         [](const auto& test) { return std::string(test.param); });

}  // namespace
}  // namespace semfield
