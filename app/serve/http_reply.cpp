#include "app/serve/http_reply.h"

#include <fmt/format.h>

#include <algorithm>

namespace semfield::app {

namespace {

using Clock = std::chrono::steady_clock;

constexpr std::size_t kReadAtOnce = std::size_t{64} << 10;
constexpr double kLeastBytesPerSecond = 20e3;
constexpr auto kGrace = std::chrono::seconds(20);

const char* reason(int status) {
  switch (status) {
    case 200:
      return "OK";
    case 308:
      return "Permanent Redirect";
    case 400:
      return "Bad Request";
    case 403:
      return "Forbidden";
    case 404:
      return "Not Found";
    case 405:
      return "Method Not Allowed";
    case 408:
      return "Request Timeout";
    case 413:
      return "Content Too Large";
    case 503:
      return "Service Unavailable";
    default:
      return "Internal Server Error";
  }
}

std::string head_text(const HttpResponse& response, std::size_t bytes, bool keep) {
  std::string head = fmt::format(
      "HTTP/1.1 {} {}\r\nContent-Type: {}\r\nContent-Length: {}\r\nCache-Control: {}\r\nConnection: {}\r\n"
      "Referrer-Policy: no-referrer\r\nX-Content-Type-Options: nosniff\r\nX-Frame-Options: DENY\r\n"
      "Cross-Origin-Resource-Policy: same-origin\r\n"
      "Content-Security-Policy: default-src 'self'{}; img-src 'self' blob: data:; frame-ancestors 'none'; base-uri "
      "'none'; form-action 'none'\r\n",
      response.status, reason(response.status), response.type, bytes, response.cache, keep ? "keep-alive" : "close",
      response.own_code ? " 'unsafe-inline'" : "");
  if (!response.location.empty()) head += "Location: " + response.location + "\r\n";
  if (!response.allow.empty()) head += "Allow: " + response.allow + "\r\n";
  if (!response.download_name.empty())
    head += "Content-Disposition: attachment; filename=\"" + response.download_name + "\"\r\n";
  return head + "\r\n";
}

}  // namespace

HttpReply::HttpReply(HttpResponse response, bool keep, bool body) : keep_(keep) {
  std::size_t bytes = response.body.size();
  if (!response.file.empty()) {
    file_.reset(std::fopen(response.file.c_str(), "rbe"));
    if (file_ == nullptr || std::fseek(file_.get(), 0, SEEK_END) != 0) {
      response = {404, "text/plain", "the file is gone\n"};
      file_.reset();
      bytes = response.body.size();
    } else {
      bytes = left_ = static_cast<std::size_t>(std::ftell(file_.get()));
      std::rewind(file_.get());
    }
  }
  end_ = Clock::now() + kGrace +
         std::chrono::duration_cast<Clock::duration>(
             std::chrono::duration<double>(static_cast<double>(bytes) / kLeastBytesPerSecond));
  bytes_ = head_text(response, bytes, keep);
  if (!body) {
    left_ = 0;
  } else if (file_ == nullptr) {
    bytes_ += response.body;
  }
}

std::string_view HttpReply::piece() {
  if (at_ == bytes_.size() && left_ > 0) {
    at_ = 0;
    bytes_.resize(std::min(left_, kReadAtOnce));
    bytes_.resize(std::fread(bytes_.data(), 1, bytes_.size(), file_.get()));
    left_ -= bytes_.size();
  }
  return std::string_view(bytes_).substr(at_);
}

}  // namespace semfield::app
