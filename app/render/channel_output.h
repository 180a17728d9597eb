// What `render` writes of heads in addition to that of class logits: their channels, and where they point along given
// vectors.
#pragma once

#include <string>
#include <vector>

#include "eval/channel_query.h"
#include "eval/evaluator.h"
#include "session/session.h"

namespace semfield::app {

struct ChannelWishes {
  std::string channel;  ///< of --channel; "": none
  std::string query;    ///< file of --query; "": none
};

class ChannelOutput {
 public:
  /// Throws Error(usage) for a run without such a head, and what read_queries throws.
  ChannelOutput(const ChannelWishes& wishes, const Session& session);

  /// Channels that frames must have.
  const std::vector<std::string>& channels() const { return channels_; }
  /// Files of the whole folder: the axes of the channel, where it has some.
  void write_axes(const std::string& folder) const;
  /// Files of a frame, whose names begin with `base`.
  void write(const std::string& base, const RenderedFrame& frame) const;

 private:
  std::vector<std::string> channels_;
  bool maps_ = false;  // the channel itself is written
  View<const float> axes_;
  std::vector<QueryVector> queries_;
};

}  // namespace semfield::app
