// Figures by the rules of published evaluations: which frames and classes count, and what is void.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "eval/evaluator.h"

namespace semfield {

/// What a protocol says. All pool the pixels of the held-out frames into one confusion matrix and take the mean of IoU
/// and of recall over the classes present in truth.
struct Protocol {
  std::string name;
  std::string cites;                 ///< keys of references.bib
  std::vector<std::string> classes;  ///< names that count; empty: every class of the scene that is not void
  std::string void_rule;             ///< a sentence
};
/// semantic_nerf [Zhi21], panoptic_lifting [Siddiqui23], nyu40 [Gupta13], scannet20 [Dai17]. Throws Error(usage) for
/// another name.
Protocol protocol_named(const std::string& name);
std::vector<std::string> protocol_names();

struct ProtocolClass {
  std::string name;
  std::int64_t truth_px = 0;
  std::optional<double> iou;  ///< none where the class is not in truth
};

struct ProtocolScore {
  Protocol protocol;
  std::vector<ProtocolClass> classes;     ///< those of the scene's table that count, in its order
  std::vector<std::string> void_classes;  ///< of the scene's table that do not: their truth is void
  std::int64_t scored_px = 0;
  std::optional<double> miou, total_accuracy, average_accuracy;  ///< none without scored pixels
};

/// From a confusion matrix of the scene's classes. Names are compared in small letters, '-' and '_' as blanks. A
/// prediction of a class that does not count is wrong. Throws Error(data) where no class of the table counts.
ProtocolScore protocol_score(const Protocol& protocol, const ConfusionMatrix& confusion, const ClassTable& classes);

/// CRC-32C of names, sizes and class ids of the truth of frames, in hexadecimal digits: equal where the truth is.
std::string truth_hash(std::span<const int> frames, const std::vector<FrameInfo>& infos,
                       const std::vector<StoredFrame>& stored, const ClassTable& classes);

}  // namespace semfield
