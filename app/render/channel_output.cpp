#include "app/render/channel_output.h"

#include <fmt/format.h>

#include <algorithm>

#include "eval/image_output.h"
#include "formats/image_io.h"

namespace semfield::app {

namespace {

// Between the 2nd and the 98th percentile of the picture: cosines of words and pictures differ by little.
std::vector<std::uint8_t> contrast_colors(const std::vector<float>& values) {
  std::vector<float> sorted = values;
  std::sort(sorted.begin(), sorted.end());
  const std::size_t last = sorted.size() - 1;
  const double low = static_cast<double>(sorted[last / 50]), high = static_cast<double>(sorted[last - last / 50]);
  std::vector<std::uint8_t> rgb;
  rgb.reserve(3 * values.size());
  for (const float value : values) {
    const double t = high > low ? (static_cast<double>(value) - low) / (high - low) : 0;
    const auto color = perceptual_color(t);
    rgb.insert(rgb.end(), color.begin(), color.end());
  }
  return rgb;
}

const HeadConfig& head_of(const ChannelWishes& wishes, const Session& session) {
  const std::vector<HeadConfig>& heads = session.config.heads;
  std::vector<std::string> known;
  for (const HeadConfig& head : heads) {
    known.push_back(head.channel);
    if (head.channel == wishes.channel || (wishes.channel.empty() && heads.size() == 1)) return head;
  }
  if (known.empty())
    throw Error(ErrorKind::usage, "render.channel.unknown", "the run has no head except that of class logits",
                "train with the lists `heads` and `losses`; docs/guide/features.md shows how");
  if (wishes.channel.empty())
    throw Error(ErrorKind::usage, "render.channel.unknown", "the run has several channels: " + join(known),
                "name one with --channel");
  const std::string near = did_you_mean(wishes.channel, known);
  throw Error(ErrorKind::usage, "render.channel.unknown",
              "--channel: the run has no channel '" + wishes.channel + "'; it has " + join(known),
              near.empty() ? "" : "did you mean '" + near + "'?");
}

}  // namespace

ChannelOutput::ChannelOutput(const ChannelWishes& wishes, const Session& session) : maps_(!wishes.channel.empty()) {
  if (wishes.channel.empty() && wishes.query.empty()) return;
  const HeadConfig& head = head_of(wishes, session);
  channels_.push_back(head.channel);
  axes_ = session.pipeline->passes().back().axes(head.channel);
  if (!wishes.query.empty())
    queries_ = read_queries(wishes.query, head.source_width > 0 ? head.source_width : head.width);
  maps_ = maps_ && wishes.query.empty();
}

void ChannelOutput::write_axes(const std::string& folder) const {
  if (!maps_ || axes_.empty()) return;
  const std::vector<std::int64_t> shape{axes_.rows, axes_.cols};
  write_npy(folder + "/" + channels_.front() + "_axes.npy", shape,
            {axes_.data, static_cast<std::size_t>(axes_.size())});
}

void ChannelOutput::write(const std::string& base, const RenderedFrame& frame) const {
  for (const FrameChannel& map : frame.channels) {
    if (maps_) {
      const std::vector<std::int64_t> shape{map.height, map.width, map.cols};
      write_npy(base + "_" + map.name + ".npy", shape, map.values);
    }
    for (const QueryVector& query : queries_) {
      const std::vector<float> cosines = cosine_map(map, query.values, axes_);
      const std::string file = base + "_query_" + query.name;
      write_map_npy(file + ".npy", {map.width, map.height}, cosines);
      write_png_rgb(file + ".png", map.width, map.height, contrast_colors(cosines));
    }
  }
}

}  // namespace semfield::app
