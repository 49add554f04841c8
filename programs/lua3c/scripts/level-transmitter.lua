-----
-- script do transmissor (lê do sensor e publica a informação de nível na rede)
-----

local function getLevel()
v = ((h3c.aIn(0)-70)*100)/(430);
if v>100 then
v = 100
end
if (v<0) then
v = 0
end
return v
end

id = 10
outputprint = 0
while true do
level = getLevel()
n3c.tx(id, level)
o3c.dms(50)
outputprint = outputprint + 1
if outputprint == 3 then
print(level .. '\r')
outputprint = 0
end
end
