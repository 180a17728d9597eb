// The public wrappers refuse wrong shapes with a sentence, and never call an implementation with nothing to do.
#include <gtest/gtest.h>

#include "testkit/guarded.h"
#include "testkit/tensor_box.h"
#include "tests/plugin/toy_encoder.h"

namespace semfield {
namespace {

using testkit::Guarded;

std::string message_of(const std::function<void()>& call) {
  try {
    call();
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::internal);
    return error.message();
  }
  return "nothing was thrown";
}

class CheckedEncoder : public testing::Test {
 protected:
  KernelTables kernels;
  toy::ToyEncoder<float> encoder{toy::ToyParams{}, EncoderBuild{}, kernels};
  testkit::TensorBox<float> box{encoder, 1};
  Workspace workspace;
  StepContext ctx{1, 0, true, 0, 0, &workspace};
  Guarded<double> x{4, 3};
  Guarded<float> y{4, 2};
  CheckedEncoder() { x.fill(0.25); }
};

TEST_F(CheckedEncoder, NamesTheViewOfAWrongShape) {
  EXPECT_EQ(message_of([&] { encoder.forward(ctx, box.tensors(), x.view(), y.view().row_range(0, 3)); }),
            "encoder.forward: y is [3, 2], expected [4, 2]");
  EXPECT_EQ(message_of([&] { encoder.forward(ctx, box.tensors(), x.view().col_range(0, 2), y.view()); }),
            "encoder.forward: x is [4, 2], expected [4, 3]");
}

TEST_F(CheckedEncoder, RefusesEmptyOverlappingAndForeignViews) {
  EXPECT_EQ(message_of([&] { encoder.forward(ctx, box.tensors(), x.view(), View<float>(nullptr, 4, 2)); }),
            "encoder.forward: y is empty and must not be");
  EXPECT_EQ(message_of([&] { encoder.forward(ctx, box.tensors(), x.view(), View<float>(y.view().data, 4, 2, 1)); }),
            "encoder.forward: y has a row stride below its columns");
  EXPECT_EQ(message_of([&] {
              encoder.forward(ctx, box.tensors(), x.view(), View<float>(y.view().data, 4, 2, 2, Device::cuda));
            }),
            "encoder.forward: y lives on another device than the first argument");
}

TEST_F(CheckedEncoder, BackwardWantsGradients) {
  y.fill(1);
  EXPECT_EQ(message_of([&] { encoder.backward(ctx, box.values_only(), x.view(), y.view(), {}); }),
            "encoder.backward: the tensors have no gradients");
}

TEST_F(CheckedEncoder, ZeroRowsWriteNothing) {
  encoder.forward(ctx, box.tensors(), x.view().row_range(0, 0), y.view().row_range(0, 0));
  encoder.forward(ctx, box.tensors(), View<const double>(nullptr, 0, 3), View<float>(nullptr, 0, 2));
  EXPECT_NE(y.unwritten(), "");
}

}  // namespace
}  // namespace semfield
