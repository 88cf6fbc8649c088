// node-mavlink listens to the simulated autopilot, asks for a few rates and decodes all that comes.
//
// decode.mjs PACKAGE PORT SECONDS: PACKAGE is the folder of node-mavlink. Prints what it saw as one line of JSON.
import { createSocket } from 'node:dgram'
import { createRequire } from 'node:module'

const [folder, port, seconds] = [process.argv[2], Number(process.argv[3]), Number(process.argv[4])]
const { MavLinkPacketSplitter, MavLinkPacketParser, MavLinkProtocolV2, minimal, standard, common, ardupilotmega } =
  createRequire(import.meta.url)(folder)

const registry = { ...minimal.REGISTRY, ...standard.REGISTRY, ...common.REGISTRY, ...ardupilotmega.REGISTRY }
const socket = createSocket('udp4')
const splitter = new MavLinkPacketSplitter()
const parser = splitter.pipe(new MavLinkPacketParser())
const protocol = new MavLinkProtocolV2(255, 190)
const seen = { counts: {}, unknown: [], gaps: 0, last: {}, acks: {} }
let sequence = 0
let expected = -1

function send(message) {
  socket.send(protocol.serialize(message, sequence++ & 0xff), port, '127.0.0.1')
}

function command(number, one, two) {
  const message = new common.CommandLong()
  Object.assign(message, { targetSystem: 1, targetComponent: 1, command: number, confirmation: 0 })
  Object.assign(message, { _param1: one, _param2: two, _param3: NaN, _param4: NaN, _param5: NaN, _param6: NaN, _param7: NaN })
  send(message)
}

parser.on('data', packet => {
  if (packet.header.compid === 1) {
    seen.gaps += expected >= 0 && packet.header.seq !== expected ? 1 : 0
    expected = (packet.header.seq + 1) & 0xff
  }
  const kind = registry[packet.header.msgid]
  if (!kind) {
    seen.unknown.push(packet.header.msgid)
    return
  }
  const data = packet.protocol.data(packet.payload, kind)
  seen.counts[kind.MSG_NAME] = (seen.counts[kind.MSG_NAME] ?? 0) + 1
  seen.last[kind.MSG_NAME] = data
  if (kind.MSG_NAME === 'COMMAND_ACK') seen.acks[data.command] = data.result
})

socket.on('message', data => splitter.write(data))
socket.bind(0, '127.0.0.1', () => {
  const heartbeat = new minimal.Heartbeat()
  Object.assign(heartbeat, { type: 6, autopilot: 8, baseMode: 0, customMode: 0, systemStatus: 4, mavlinkVersion: 3 })
  send(heartbeat)
  const asked = [31, 105, 32, 1]
  asked.forEach((message, i) => setTimeout(() => command(511, message, 20000), 200 + 100 * i))
  setTimeout(() => command(520, 1, 0), 700)
  setTimeout(() => command(31999, 0, 0), 800)
  setTimeout(() => {
    seen.valid = splitter.validPackages
    seen.invalid = splitter.invalidPackages
    console.log(JSON.stringify(seen, (_, value) => (typeof value === 'bigint' ? Number(value) : value)))
    process.exit(0)
  }, 1000 * seconds)
})
