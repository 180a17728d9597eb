// Group H: metrics of images and labels that have nothing, or nothing sound, to compare. Metrics read fp32 and sum in
// float64.

#include "eval/metrics.h"
#include "named_case.h"
#include "scene/classes/class_table.h"
#include "train/metrics_log.h"

namespace semfield::numerics {

namespace {

std::vector<float> noise(std::size_t count, std::uint64_t seed) {
  std::vector<float> out(count);
  for (std::size_t i = 0; i < count; ++i) out[i] = uniform01({seed, 0, stream_id("stiff metrics")}, i);
  return out;
}

// A row through the file's own format and back.
MetricsRow written_and_read(const MetricsRow& row) {
  return parse_metrics(metrics_line(row) + "\n", "metrics.jsonl").at(0);
}

bool is(const std::optional<double>& value, double truth) { return value && std::abs(*value - truth) < 1e-15; }

}  // namespace

void psnr_identical(CaseRun& run) {
  run.row("fp32");
  const std::vector<float> image = noise(3 * 40 * 30, 1);
  ColorError same;
  same.add(image, image);
  run.measure(same.mse().value_or(1), 0, "mean squared error");
  run.expect(same.psnr_db() && std::isinf(*same.psnr_db()) && *same.psnr_db() > 0, "PSNR is +infinity");
  run.near(ssim(image, image, 40, 30, 3).value_or(0), 1, 1e-12, "SSIM of an image with itself");
  MetricsRow row;
  row.set("psnr", same.psnr_db());
  const std::string line = metrics_line(row);
  run.expect(line.find("\"psnr\":\"inf\"") != std::string::npos, "JSON has the text inf: " + line);
  run.expect(std::isinf(written_and_read(row).get("psnr").value_or(0)), "which reads back as infinity");
  // Beside it: one value off by one rounding, and noise against long double.
  std::vector<float> near = image;
  near[7] = std::nextafter(near[7], 2.0F);
  ColorError nearly;
  nearly.add(image, near);
  run.expect(nearly.psnr_db() && std::isfinite(*nearly.psnr_db()) && *nearly.psnr_db() > 150, "one rounding is finite");
  const std::vector<float> other = noise(image.size(), 2);
  long double sum = 0;
  for (std::size_t i = 0; i < image.size(); ++i) {
    const long double d = long_double(image[i]) - other[i];
    sum += d * d;
  }
  ColorError far;
  far.add(image, other);
  run.relative(far.psnr_db().value_or(0), -10 * std::log10(sum / long_double(image.size())), 1e-12, "PSNR of noise");
}

void nan_pixel(CaseRun& run) {
  run.row("fp32");
  const std::vector<float> truth = noise(3 * 16 * 16, 3);
  const float bad[] = {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity(),
                       -std::numeric_limits<float>::infinity()};
  for (const float value : bad) {
    for (const std::size_t place : {std::size_t{0}, truth.size() / 2, truth.size() - 1}) {
      std::vector<float> image = truth;
      image[place] = value;
      ColorError color, sound;
      sound.add(truth, truth);
      color.add(truth, image);
      run.expect(!color.mse() && !color.psnr_db() && color.nonfinite() == 1, "colour is invalid, one value counted");
      sound.merge(color);
      run.expect(!sound.psnr_db() && sound.nonfinite() == 1, "a sound frame does not hide it");
      run.expect(!ssim(truth, image, 16, 16, 3), "SSIM has no value");
      DepthError depth;
      depth.add(std::vector<float>{1, 2, 3}, std::vector<float>{1, value, 3});
      run.expect(!depth.rmse() && !depth.abs_rel() && !depth.delta(1) && depth.nonfinite() == 1, "depth is invalid");
      Calibration calibration;
      const std::vector<std::int16_t> classes{0, 1};
      calibration.add(std::vector<float>{0.5F, value}, std::vector<float>(2, 0.5F), classes, classes);
      run.expect(!calibration.ece() && !calibration.nll() && calibration.nonfinite() == 1, "calibration is invalid");
      MetricsRow row;
      row.set("psnr", color.psnr_db());
      run.expect(metrics_line(row).find("\"psnr\":null") != std::string::npos, "no value is written as null");
      run.expect(!written_and_read(row).get("psnr"), "and read back as none");
    }
  }
}

void void_frames(CaseRun& run) {
  run.row("fp32");
  const std::vector<std::int16_t> nothing(100, kVoid), some(100, 1);
  ConfusionMatrix confusion(5);
  confusion.add(nothing, some);
  run.expect(confusion.scored_px() == 0 && confusion.void_truth_px() == 100, "100 void pixels, none scored");
  run.expect(
      !confusion.miou() && !confusion.miou_present() && !confusion.total_accuracy() && !confusion.average_accuracy(),
      "every score is 'no data'");
  for (const ClassScore& score : confusion.per_class())
    run.expect(!score.iou && !score.recall && score.truth_px == 0 && score.predicted_px == 0, "no class has one");
  ConfusionMatrix predicted_void(5);
  predicted_void.add(some, nothing);
  run.expect(predicted_void.scored_px() == 0 && predicted_void.void_predicted_px() == 100 && !predicted_void.miou(),
             "void predictions are counted, not scored");
  const ConfusionMatrix none(0);
  run.expect(!none.miou() && none.per_class().empty(), "a scene without classes has no score");
  Calibration calibration;
  calibration.add(std::vector<float>(100, 0.5F), std::vector<float>(100, 0.5F), some, nothing);
  run.expect(!calibration.ece() && !calibration.nll() && calibration.scored_px() == 0, "no calibration either");
  run.expect(!ColorError().psnr_db() && !DepthError().rmse() && !DepthError().coverage(), "nor of no pixels at all");
  MetricsRow row;
  row.set("miou", confusion.miou());
  run.expect(metrics_line(row).find("\"miou\":null") != std::string::npos, "it is written as null, never 0");
  // A frame that has labels then counts alone.
  ConfusionMatrix labelled(5);
  labelled.add(some, some);
  confusion.merge(labelled);
  run.expect(is(confusion.miou(), 1) && confusion.scored_px() == 100, "a labelled frame beside it scores as it is");
}

void absent_classes(CaseRun& run) {
  run.row("fp32");
  // Truth 0 0 0 0 1 1 1 1, predicted 0 0 0 1 1 1 2 2: class 2 is predicted alone, class 3 is nowhere.
  ConfusionMatrix confusion(4);
  confusion.add(std::vector<std::int16_t>{0, 0, 0, 0, 1, 1, 1, 1, kVoid, 1},
                std::vector<std::int16_t>{0, 0, 0, 1, 1, 1, 2, 2, 0, kVoid});
  const auto exactly = [&](const std::optional<double>& value, double truth, const char* what) {
    run.measure(value ? std::abs(*value - truth) : 1, 1e-15, what);
  };
  const std::vector<ClassScore> scores = confusion.per_class();
  exactly(scores[0].iou, 3.0 / 4, "IoU of class 0");
  exactly(scores[1].iou, 2.0 / 5, "IoU of class 1");
  exactly(scores[2].iou, 0, "IoU of a class that is predicted alone");
  run.expect(!scores[3].iou && !scores[2].recall && !scores[3].recall, "what is 0 / 0 has no value");
  exactly(confusion.miou(), (3.0 / 4 + 2.0 / 5 + 0) / 3, "mIoU over classes with a union");
  exactly(confusion.miou_present(), (3.0 / 4 + 2.0 / 5) / 2, "mIoU over classes present in truth");
  exactly(confusion.average_accuracy(), (3.0 / 4 + 2.0 / 4) / 2, "mean recall");
  exactly(confusion.total_accuracy(), 5.0 / 8, "total accuracy");
  run.expect(confusion.scored_px() == 8 && confusion.void_truth_px() == 1 && confusion.void_predicted_px() == 1,
             "8 scored, one void of each side");
  run.expect_error(ErrorKind::data, {"pixel 1", "predicted label 4", "[0, 4)"}, [&] {
    confusion.add(std::vector<std::int16_t>{0, 1}, std::vector<std::int16_t>{0, 4});
  });
  run.expect_error(ErrorKind::data, {"pixel 0", "true label -2"}, [&] {
    confusion.add(std::vector<std::int16_t>{-2, 1}, std::vector<std::int16_t>{0, 1});
  });
  run.expect(confusion.scored_px() == 8, "a refused frame changed nothing");
}

void depth_zero(CaseRun& run) {
  run.row("fp32");
  DepthError depth(10);
  // Truth beyond far, 0, NaN and negative is none; of four sound ones two are predicted as 0 or less.
  const float nan = std::numeric_limits<float>::quiet_NaN();
  depth.add(std::vector<float>{1, 2, 4, 5, 0, 20, nan, -1}, std::vector<float>{0, 3, -1, 5, 1, 1, 1, 1});
  run.expect(depth.valid_truth_px() == 4 && depth.scored_px() == 2 && depth.nonfinite() == 0, "2 of 4 are scored");
  run.near(depth.coverage().value_or(0), 0.5, 0, "coverage");
  run.near(depth.abs_rel().value_or(0), 0.25, 1e-15, "|p - t| / t");
  run.near(depth.abs_diff().value_or(0), 0.5, 1e-15, "|p - t|");
  run.near(depth.sq_rel().value_or(0), 0.25, 1e-15, "(p - t)^2 / t");
  run.near(depth.rmse().value_or(0), std::sqrt(0.5), 1e-15, "rmse");
  run.near(depth.delta(1).value_or(0), 0.5, 0, "delta 1: a ratio of 1.5 is outside 1.25");
  run.near(depth.delta(2).value_or(0), 1, 0, "delta 2: and inside 1.25^2");
  DepthError dark(10);
  dark.add(std::vector<float>{1, 2}, std::vector<float>{0, 0});
  run.expect(!dark.rmse() && !dark.delta(1), "a dark picture has no depth error");
  run.measure(dark.coverage().value_or(1), 0, "and says so: its coverage is 0");
}

}  // namespace semfield::numerics
